"""The rules that compare trials, in Ray Tune's terms."""

import random
from collections.abc import Callable, Mapping
from typing import Any

from ray.tune.schedulers import FIFOScheduler, PopulationBasedTraining, TrialScheduler

from msk_ray.experiment.outcomes import Ending
from msk_ray.experiment.scheduler_log import LogEntry, SchedulerLog
from msk_ray.sweep.operators import Operator, Range
from msk_ray.sweep.rules.early_stopping import Pruner
from msk_ray.sweep.rules.population import PopulationBasedTraining as PopulationSpec

METRIC = "score"
"""What trials report to Tune; `eval/score` under a name Tune does not take for a nested key."""
BEST = "best"
"""The highest score so far; no trial reports what its policy scored untrained."""


class PruningScheduler(FIFOScheduler):
    """Stops the trials that a `Pruner` names, and records why.

    A result that arrives again, from a trial that was resumed from its checkpoint, has already been judged.
    """

    def __init__(
        self,
        pruner: Pruner,
        time_attr: str,
        journal: SchedulerLog,
        identify: Callable[[Any], str],
        on_stop: Callable[[str, Ending], None],
    ) -> None:
        """
        Args:
            pruner: the rule, in the state recorded by the journal.
            time_attr: key of a result at which trials are compared.
            journal: what the rule has been told so far; new results are appended.
            identify: id of the trial that a Ray trial runs.
            on_stop: called with the id and the ending before the trial is stopped.
        """
        super().__init__()
        self._pruner = pruner
        self._time_attr = time_attr
        self._journal = journal
        # The first result of another attempt is new, whatever the previous attempt has reported.
        self._heard = {report.trial: (report.attempt, report.epoch) for report in journal.read()[0]}
        self._identify = identify
        self._on_stop = on_stop

    def on_trial_result(self, tune_controller: Any, trial: Any, result: dict[str, Any]) -> str:
        if METRIC not in result:
            return TrialScheduler.CONTINUE
        trial_id = self._identify(trial)
        report = LogEntry(
            trial_id,
            result["epoch"],
            result["env_steps"],
            result["seconds"],
            result[METRIC],
            result["ended"],
            result["attempt"],
        )
        heard = self._heard.get(trial_id, (1, -1))
        if (report.attempt, report.epoch) <= heard:
            return TrialScheduler.CONTINUE
        self._heard[trial_id] = report.attempt, report.epoch
        self._journal.append(report)
        if report.attempt > heard[0]:
            self._pruner.forget(trial_id)
        ending = self._pruner.report(trial_id, report.time(self._time_attr), report.score)
        # A trial that has ended by itself still counts for the others, but has its own outcome.
        if ending is None or result["ended"]:
            return TrialScheduler.CONTINUE
        self._on_stop(trial_id, ending)
        return TrialScheduler.STOP


class Population(PopulationBasedTraining):
    """Population-based training over the sampled ranges of a space.

    Values stay inside their ranges, and a member that continues from a better one keeps its identity: Ray by itself
    would let values leave the ranges, and copy the better member's whole config, including its identity.
    """

    def __init__(self, spec: PopulationSpec, budget: float, sampled: Mapping[str, Operator]) -> None:
        self._ranges = {key: op for key, op in sampled.items() if isinstance(op, Range)}
        super().__init__(
            time_attr=spec.time_attr,
            perturbation_interval=spec.interval * budget,
            hyperparam_mutations={"params": {key: _draw(op) for key, op in self._ranges.items()}},
            quantile_fraction=spec.quantile,
            resample_probability=spec.resample,
            log_config=False,
        )

    def _get_new_config(self, trial: Any, trial_to_clone: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        config, operations = super()._get_new_config(trial, trial_to_clone)
        moved = {key: op.clip(config["params"][key]) for key, op in self._ranges.items()}
        return {"id": trial.config["id"], "params": config["params"] | moved}, operations


def _draw(op: Operator) -> Callable[[], Any]:
    """Draws a new value from a range at each call."""
    rng = random.Random()
    return lambda: op.draw(rng).value
