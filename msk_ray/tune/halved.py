"""A trial that ran out of memory and starts anew with half its worlds: the decision, and the trial as it runs then."""

from dataclasses import replace

from msk_ray.config import parse_config
from msk_ray.errors import ConfigError
from msk_ray.experiment.halved import Halved
from msk_ray.experiment.trial import Trial
from msk_ray.sweep.trials import overlay

_WORLDS = "env.nworld"


def as_run(trial: Trial, halved: Halved | None) -> Trial:
    """A trial as it runs. It keeps its id, which stands for what was asked for.

    Raises:
        ConfigError: half the worlds do not go with its other settings.
    """
    if halved is None:
        return trial
    settings = overlay(trial.config.as_dict(), {_WORLDS: halved.worlds})
    return replace(
        trial,
        config=parse_config(settings, f"trial {trial.id} with {halved.worlds} worlds"),
        changed=trial.changed | {_WORLDS: str(halved.worlds)},
        values=trial.values | {_WORLDS: halved.worlds},
    )


class StartAnew(Exception):
    """The trial goes on with half its worlds, in a process that the failed attempt has left no memory in."""

    def __init__(self, halved: Halved) -> None:
        super().__init__(halved)
        self.halved = halved

    def __str__(self) -> str:
        return f"out of memory with {self.halved.asked} worlds: starting anew with half of them, {self.halved.worlds}"


def halve(trial: Trial, why: str) -> Halved:
    """Half of a trial's worlds, rounded down.

    Args:
        trial: as it was asked for.
        why: what it ran out of memory at.

    Raises:
        ConfigError: it has a single world, or half of them do not go with its other settings.
    """
    asked = trial.config.env.nworld
    if asked < 2:
        raise ConfigError("a single world cannot be halved")
    halved = Halved(asked, asked // 2, why)
    as_run(trial, halved)
    return halved
