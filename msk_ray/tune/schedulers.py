"""Adapters of the rules that compare trials to Ray Tune's schedulers."""

import random
from collections.abc import Callable, Mapping
from typing import Any

from ray.tune.schedulers import FIFOScheduler, PopulationBasedTraining, TrialScheduler

from msk_ray.experiment.evaluation_log import EvaluationLog, LogEntry
from msk_ray.experiment.outcomes import Ending
from msk_ray.sweep.operators import Operator, Range
from msk_ray.sweep.rules.population import PopulationBasedTraining as PopulationSpec
from msk_ray.sweep.rules.scheduler import Pruner

METRIC = "score"
"""Key under which trials report `eval/score`; Tune would read a slash as a nested key."""
BEST = "best"
"""Key of the highest score so far, without the score of the untrained policy."""


class PruningScheduler(FIFOScheduler):
    """Stops trials as a `Pruner` decides, and records why.

    Results that arrive again, from a trial resumed from its checkpoint, are ignored.
    """

    def __init__(
        self,
        pruner: Pruner,
        time_attr: str,
        journal: EvaluationLog,
        identify: Callable[[Any], str],
        on_stop: Callable[[str, Ending], None],
    ) -> None:
        """
        Args:
            pruner: the rule, with the journal replayed.
            time_attr: key of a result at which trials are compared.
            journal: log of the rule's inputs; new results are appended.
            identify: id of a Ray trial's trial.
            on_stop: called with a trial's id and ending before stopping it.
        """
        super().__init__()
        self._pruner = pruner
        self._time_attr = time_attr
        self._journal = journal
        # The first result of a new attempt counts, whatever the previous attempt has reported.
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
        # A trial that has ended on its own counts for the others, but keeps its outcome.
        if ending is None or result["ended"]:
            return TrialScheduler.CONTINUE
        self._on_stop(trial_id, ending)
        return TrialScheduler.STOP


class Population(PopulationBasedTraining):
    """Population-based training over the sampled ranges of a space.

    Unlike in Ray's own class, values stay inside their ranges, and a member that continues from a better one keeps its
    id; Ray would copy the better member's whole config.

    Ray draws from Python's global generator. Here, the seed, the member and its progress determine an exchange's draws,
    so that they are the same in every run and after a resume. Which members are better still depends on the results
    available by then.
    """

    FACTORS = (0.8, 1.2)
    """Factors by which exchanged values change."""

    def __init__(self, spec: PopulationSpec, budget: float, sampled: Mapping[str, Operator], seed: int) -> None:
        """
        Args:
            spec: the space's `scheduler` section.
            budget: length of the longest trial, in the unit of `spec.time_attr`.
            sampled: the sampled parameters; those with a range are exchanged.
            seed: seed of all draws.
        """
        self._ranges = {key: op for key, op in sampled.items() if isinstance(op, Range)}
        self._seed = seed
        super().__init__(
            time_attr=spec.time_attr,
            perturbation_interval=spec.interval * budget,
            hyperparam_mutations={"params": {key: [op.low, op.high] for key, op in self._ranges.items()}},
            quantile_fraction=spec.quantile,
            resample_probability=spec.resample,
            log_config=False,
        )

    def _checkpoint_or_exploit(
        self, trial: Any, tune_controller: Any, upper_quantile: list[Any], lower_quantile: list[Any]
    ) -> None:
        if trial in lower_quantile:
            better = sorted(upper_quantile, key=lambda member: str(member.config["id"]))
            upper_quantile = [self._generator(trial, "from").choice(better)]
        super()._checkpoint_or_exploit(trial, tune_controller, upper_quantile, lower_quantile)

    def _get_new_config(self, trial: Any, trial_to_clone: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        params, operations = dict(trial_to_clone.config["params"]), {}
        rng = self._generator(trial, "values")
        for key, op in self._ranges.items():
            if rng.random() < self._resample_probability:
                params[key], operations[key] = op.draw(rng).value, "resample"
            else:
                factor = rng.choice(self.FACTORS)
                params[key], operations[key] = op.clip(params[key] * factor), f"* {factor}"
        return {"id": trial.config["id"], "params": params}, {"params": operations}

    def _generator(self, trial: Any, purpose: str) -> random.Random:
        time = self._trial_state[trial].last_perturbation_time
        return random.Random(f"{self._seed} {trial.config['id']} {time} {purpose}")
