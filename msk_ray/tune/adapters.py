"""The rules of `pruning` and the ranges of a space in Ray Tune's terms."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ray import tune
from ray.tune.schedulers import FIFOScheduler, PopulationBasedTraining, TrialScheduler
from ray.tune.search import Searcher

from msk_ray.errors import ConfigError
from msk_ray.experiment.outcomes import Ending
from msk_ray.experiment.scheduler_log import LogEntry, SchedulerLog
from msk_ray.sweep.operators import Listed, Operator, Range
from msk_ray.sweep.pruning import Pruner
from msk_ray.sweep.space import SchedulerSpec

METRIC = "score"
"""What trials report to Tune; `eval/score` under a name Tune does not take for a nested key."""
BEST = "best"
"""The highest score so far; no trial reports what its policy scored untrained."""
STARTS_ANEW = "starts_anew"
"""What a trial reports, alone, right before it fails in order to be started anew: with how many worlds."""


class PruningScheduler(FIFOScheduler):
    """Stops the trials a `Pruner` names, and says so.

    A report that is heard again, from a trial that went on from its checkpoint, has been judged already.
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
            pruner: the rule, as far as the journal goes.
            time_attr: key of a report that trials are compared at.
            journal: what the rule has been told; what it is told now is added.
            identify: id of the trial that a Ray trial runs.
            on_stop: told the id and the ending before the trial is stopped.
        """
        super().__init__()
        self._pruner = pruner
        self._time_attr = time_attr
        self._journal = journal
        # The first report with half the worlds is new, whatever was heard of the attempt with all of them.
        self._heard = {report.trial: (report.halved, report.epoch) for report in journal.read()[0]}
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
            result["halved"],
        )
        heard = self._heard.get(trial_id, (False, -1))
        if (report.halved, report.epoch) <= heard:
            return TrialScheduler.CONTINUE
        self._heard[trial_id] = report.halved, report.epoch
        self._journal.append(report)
        if report.halved and not heard[0]:
            self._pruner.forget(trial_id)
        ending = self._pruner.report(trial_id, report.time(self._time_attr), report.score)
        # A trial that has ended by itself still counts for the others, but has its own outcome.
        if ending is None or result["ended"]:
            return TrialScheduler.CONTINUE
        self._on_stop(trial_id, ending)
        return TrialScheduler.STOP


class Population(PopulationBasedTraining):
    """Population-based training over the sampled ranges of a space.

    Values stay inside their ranges, and a member that goes on from a better one stays itself: Ray alone would let it
    leave the ranges, and copy the better one's whole config, identity included.
    """

    def __init__(self, spec: SchedulerSpec, budget: float, sampled: Mapping[str, Operator]) -> None:
        self._ranges = {key: op for key, op in sampled.items() if isinstance(op, Range)}
        super().__init__(
            time_attr=spec.time_attr,
            perturbation_interval=spec.interval * budget,
            hyperparam_mutations={"params": {key: domain(op) for key, op in self._ranges.items()}},
            quantile_fraction=spec.quantile,
            resample_probability=spec.resample,
            log_config=False,
        )

    def _get_new_config(self, trial: Any, trial_to_clone: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        config, operations = super()._get_new_config(trial, trial_to_clone)
        moved = {key: op.clip(config["params"][key]) for key, op in self._ranges.items()}
        return {"id": trial.config["id"], "params": config["params"] | moved}, operations


def domain(op: Operator) -> Any:
    """Ray's distribution for a sampled parameter; a choice is drawn by its labels."""
    if isinstance(op, Listed):
        return tune.choice([level.label for level in op.levels])
    if op.kind == "randint":
        return tune.randint(int(op.low), int(op.high) + 1)
    return (tune.uniform if op.kind == "uniform" else tune.loguniform)(op.low, op.high)


def optuna_search(
    seed: int, begun: Sequence[Mapping[str, Any]] = (), scored: Sequence[tuple[Mapping[str, Any], float]] = ()
) -> Searcher:
    """Optuna's TPE sampler.

    Args:
        seed: of its draws.
        begun: choices it made before that are to be tried first, as they were.
        scored: choices it made before, and what came of them.

    Raises:
        ConfigError: Optuna is not installed.
    """
    try:
        import optuna
    except ImportError:
        raise ConfigError("search: optuna needs the optuna package: pip install optuna") from None
    from ray.tune.search.optuna import OptunaSearch

    class Informed(OptunaSearch):
        """Told what came of earlier choices as soon as it knows the space; takes reports without a score, too."""

        def on_trial_result(self, trial_id: str, result: dict[str, Any]) -> None:
            if METRIC in result:
                super().on_trial_result(trial_id, result)

        def set_search_properties(self, *args: Any, **kwargs: Any) -> bool:
            fresh: bool = super().set_search_properties(*args, **kwargs)
            for params, score in scored if fresh else ():
                self.add_evaluated_point(_flat(params), score)
            return fresh

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    # Drawing anew with the same seed would repeat the draws of the first time.
    sampler = optuna.samplers.TPESampler(seed=seed + len(begun) + len(scored))
    return Informed(metric=METRIC, mode="max", sampler=sampler, points_to_evaluate=[_flat(p) for p in begun] or None)


def _flat(params: Mapping[str, Any]) -> dict[str, Any]:
    return {f"params/{key}": value for key, value in params.items()}
