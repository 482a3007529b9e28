"""Rules that compare trials, and stop one because others do better.

A rule gets evaluations and returns reasons to stop. Replaying recorded evaluations gives the same answers.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Protocol

from pydantic import Field

from msk_ray.config.sections import Section, Text
from msk_ray.errors import ConfigError
from msk_ray.experiment.evaluation_log import LogEntry
from msk_ray.experiment.outcomes import Ending

if TYPE_CHECKING:
    from msk_ray.sweep.space import SpaceFile

Share = Annotated[float, Field(gt=0.0, lt=1.0)]


class Pruner(Protocol):
    """A rule that compares trials."""

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        """Record an evaluation; returns why its trial should end now, or None."""

    def forget(self, trial: str) -> None:
        """Forget a trial's results, because it restarts from the beginning."""


class NeverPrune:
    """Lets every trial run."""

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        return None

    def forget(self, trial: str) -> None:
        return None


class SchedulerSpec(Section):
    """The `scheduler` section of a space: a rule with its settings, which are the fields of its class.

    To write your own, derive a class from this one, and name its import path in a space:
    `scheduler: {kind: "package.module:Class", setting: value}`.
    """

    ends_trials: ClassVar[bool] = True
    """Whether it ends trials by their scores; if so, --no-early-stopping and --smoke disable it."""
    exchanges: ClassVar[bool] = False
    """Whether trials continue from each other's state and settings."""

    kind: Text
    """Name of the rule, or its import path."""
    time_attr: Literal["env_steps", "epoch", "seconds"] = "env_steps"
    """Progress at which trials are compared. Env steps are fair across horizons, and do not need lockstep."""

    def pruner(self, budget: float) -> Pruner:
        """The rule, without any evaluations yet.

        Args:
            budget: length of the longest trial, in the unit of `time_attr`.
        """
        return NeverPrune()

    def rungs(self, budget: float) -> tuple[float, ...]:
        """Times at which all trials are compared, for charts; empty if there are none."""
        return ()

    def check(self, file: "SpaceFile", ranges: Collection[str]) -> None:
        """Refuse a space that does not work with this rule.

        Args:
            file: the space.
            ranges: its parameters with a range.

        Raises:
            ConfigError: the message says what to write.
        """
        if self.time_attr == "seconds" and file.stop.wall_time_s is None:
            raise ConfigError("scheduler.time_attr: seconds needs stop.wall_time_s, of which grace is a share")


class NoScheduler(SchedulerSpec):
    """Lets every trial run."""

    ends_trials = False

    kind: Text = "none"
    time_attr: Literal["env_steps"] = "env_steps"


class PerEnvironment:
    """Passes each trial's evaluations to its environment's rule; ignores unknown trials."""

    def __init__(self, rules: Mapping[str, Pruner], environments: Mapping[str, str]) -> None:
        """
        Args:
            rules: environment → its rule.
            environments: trial → its environment.
        """
        self._rules = {trial: rules[environment] for trial, environment in environments.items()}

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        rule = self._rules.get(trial)
        return None if rule is None else rule.report(trial, time, score)

    def forget(self, trial: str) -> None:
        if trial in self._rules:
            self._rules[trial].forget(trial)


def refuse_several(environments: Iterable[str], who: str) -> None:
    """Raise if a setting would compare trials of different environments.

    Args:
        environments: names of the trials' environments.
        who: the setting that compares them, and what it does.

    Raises:
        ConfigError: there is more than one environment.
    """
    names = list(dict.fromkeys(environments))
    if len(names) > 1:
        raise ConfigError(
            f"{who}, and scores of different environments ({', '.join(names)}) cannot be compared; write a space for "
            "each"
        )


def replay(pruner: Pruner, time_attr: str, reports: Sequence[LogEntry]) -> Ending | None:
    """Replay recorded evaluations.

    Returns:
        The rule's answer to the last evaluation; the driver may have died before carrying it out.
    """
    ending = None
    attempts: dict[str, int] = {}
    for report in reports:
        if report.attempt > attempts.setdefault(report.trial, report.attempt):
            attempts[report.trial] = report.attempt
            pruner.forget(report.trial)
        ending = pruner.report(report.trial, report.time(time_attr), report.score)
    return None if not reports or reports[-1].ended else ending
