"""Runs an experiment's trials with Ray Tune."""

import logging
import math
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ray
from ray import tune
from ray.exceptions import RayTaskError
from ray.tune.stopper import Stopper
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from msk_ray.config import Config, parse_recorded, value_at
from msk_ray.errors import ClusterLost, MskRayError, OwnershipLost, StorageFailure, storage_failure
from msk_ray.experiment.attempts import read_attempt
from msk_ray.experiment.damage import describe_damages, read_settings
from msk_ray.experiment.evaluation_log import EvaluationLog
from msk_ray.experiment.layout import EVALUATION_LOG_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import last_figures
from msk_ray.experiment.outcomes import read_ending, write_ending
from msk_ray.experiment.ownership import Ownership
from msk_ray.experiment.records import read_record
from msk_ray.experiment.trial import Trial, by_environment
from msk_ray.progress import announce, format_duration
from msk_ray.signals import StopRequest, listening
from msk_ray.sweep.budget import extreme_configs, longest_budget
from msk_ray.sweep.operators import NamedValues
from msk_ray.sweep.rules.population import PopulationBasedTraining
from msk_ray.sweep.rules.scheduler import PerEnvironment, Pruner, replay
from msk_ray.sweep.search import search_class
from msk_ray.sweep.search_trials import SearchTrial, recover
from msk_ray.sweep.space import Space
from msk_ray.sweep.trials import base_settings
from msk_ray.tune.console import Console
from msk_ray.tune.devices import Placement
from msk_ray.tune.gauges import StateGauge
from msk_ray.tune.interrupts import run_in_thread
from msk_ray.tune.queue import Suggestions, TrialList
from msk_ray.tune.ray_watch import RayWatch
from msk_ray.tune.schedulers import METRIC, Population, PruningScheduler
from msk_ray.tune.shared_trials import SharedTrials
from msk_ray.tune.supervisor import Supervisor, remove_remains
from msk_ray.tune.trainable import Job, make_trainable
from msk_ray.tune.trial_run import MakeTrainer, Precompile, make_trainer, precompile
from msk_ray.tune.worker_prestart import WorkerPrestart, nodes_for


@dataclass(frozen=True)
class Plan:
    """Everything that determines how an experiment's trials run."""

    experiment: Experiment
    space: Space
    trials: list[Trial]
    """All trials of the experiment, including those that have ended; empty if a search suggests them."""
    placement: Placement
    max_concurrent: int | None
    make_trainer: MakeTrainer = make_trainer
    precompile: Precompile | None = precompile
    """Compiles a config's kernels on a node before trials start; None if there is nothing to compile."""
    prestart: bool = True
    """Whether to keep processes ready for the next trials."""
    ownership: Ownership | None = None
    """Ownership of the experiment; None for one that no other process can know of."""

    def guard(self) -> None:
        """Check that this driver still owns the experiment.

        Raises:
            OwnershipLost: another process does.
        """
        if self.ownership is not None:
            self.ownership.check()


def run_trials(plan: Plan) -> bool:
    """Run all trials that have not ended yet. Needs a Ray session.

    Returns:
        False if it was asked to stop and ended early; the experiment can be resumed.

    Raises:
        StorageFailure: the disk is full or gone; the experiment can be resumed once it is back.
        MskRayError: kernels could not be compiled for a trial.
    """
    experiment, space = plan.experiment, plan.space
    _finish_pruning(plan)
    remaining = [t for t in plan.trials if read_record(t, experiment.trial_folder(t.id)).ending is None]
    suggested = [] if plan.trials else recover(experiment, space)
    begun = [s for s in suggested if read_record(s.trial, experiment.trial_folder(s.trial.id)).ending is None]
    missing = space.file.samples - len(suggested) + len(begun)
    if (plan.trials and not remaining) or (suggested and missing <= 0):
        print("all trials have ended already")
        return True
    base = base_settings(space) if not plan.trials else {}
    job = Job(
        experiment,
        space,
        base,
        SharedTrials(plan.trials),
        plan.placement.device,
        plan.placement.gpus,
        plan.make_trainer,
        None if plan.ownership is None else plan.ownership.owner.token,
    )
    if plan.precompile is not None:
        _precompile(plan, remaining or [_first_suggestion(job)])
    for trial in remaining:
        experiment.make_trial_folder(trial.id)
    total = ray.cluster_resources()
    concurrent = plan.placement.concurrent(total.get("GPU", 0.0), total.get("CPU", 1.0), plan.max_concurrent)
    print(
        f"{len(remaining) or missing} trials, {concurrent} at a time on "
        f"{f'{plan.placement.gpus:g} GPU each' if plan.placement.gpus else 'CPU'}; into {experiment.path}",
        flush=True,
    )
    announce("starting the first trials")
    with listening() as stop, stop.deferred(), RayWatch() as watch:
        console = Console(remaining, concurrent)
        supervisor = Supervisor(
            experiment,
            job.trial_of,
            console,
            stop,
            watch.guarding(plan.guard),
            waiting=remaining,
            started=[s.trial for s in suggested],
        )
        _fit(plan, job, supervisor, stop, watch, remaining, suggested)
        if not plan.trials:
            # Add the trials that a search has suggested to the manifest.
            experiment.set_trials(supervisor.started)
        return not stop


def _journal(plan: Plan) -> EvaluationLog:
    return EvaluationLog(plan.experiment.path / EVALUATION_LOG_FILE, plan.guard)


def _finish_pruning(plan: Plan) -> None:
    """Write the ending of a trial that the rule stopped just before the driver died."""
    spec = plan.space.file.scheduler
    reports, damages = _journal(plan).read()
    for line in describe_damages(damages, plan.experiment.path):
        print(f"skipped: {line}", flush=True)
    if not reports or not plan.trials:
        return
    ending = replay(_pruner(plan), spec.time_attr, reports)
    folder = plan.experiment.trial_folder(reports[-1].trial)
    if ending is None or read_ending(folder) is not None:
        return
    # Scores of an earlier attempt must not end this one.
    if reports[-1].attempt == read_attempt(folder).number:
        write_ending(folder, ending)


def _fit(
    plan: Plan,
    job: Job,
    supervisor: Supervisor,
    stop: StopRequest,
    watch: RayWatch,
    remaining: list[Trial],
    suggested: list[SearchTrial],
) -> None:
    """Run the remaining trials, with all callbacks.

    Raises:
        StorageFailure: the disk is full or gone, even if only a trial has noticed.
        ClusterLost: Ray has died or does not answer.
        Exception: whatever else ends Tune's loop.
    """
    file = plan.space.file
    resources = {"cpu": plan.placement.cpus} | ({"gpu": plan.placement.gpus} if plan.placement.gpus else {})
    # A search decides its number of samples; a list of trials is a parameter space to run once.
    search: Any
    if file.searches:
        search, samples = _suggestions(plan, suggested, job), -1
    else:
        search, samples = TrialList(plan.max_concurrent), 1
    ahead = WorkerPrestart(plan.placement, plan.max_concurrent, supervisor.waiting, supervisor.console.say)
    states = StateGauge(plan.experiment, remaining, job.trial_of)
    tuner = tune.Tuner(
        make_trainable(job, resources),
        param_space=_param_space(job, remaining),
        tune_config=tune.TuneConfig(
            metric=METRIC,
            mode="max",
            scheduler=_scheduler(plan, job, supervisor),
            search_alg=search,
            num_samples=samples,
            max_concurrent_trials=plan.max_concurrent,
            reuse_actors=False,  # a new process per trial frees all of its GPU memory
            trial_dirname_creator=lambda trial: f"{trial.config.get('id', 'trial')}_{trial.trial_id}",
        ),
        run_config=tune.RunConfig(
            name="tune",
            storage_path=str(plan.experiment.path),
            verbose=0,
            # The supervisor comes first, because it writes the endings that only the driver knows.
            callbacks=[supervisor, states, *([ahead] if plan.prestart else [])],
            stop=_StopWhen(supervisor),
            failure_config=tune.FailureConfig(max_failures=file.resources.max_failures),
            # Keep all: only populations have checkpoints here, and another member may be about to read one.
            checkpoint_config=tune.CheckpointConfig(num_to_keep=None),
        ),
    )
    try:
        with closing(states), _log_to(plan.experiment.path / "ray.log"):
            run_in_thread(tuner.fit, stop, watch)
    except ClusterLost:
        raise
    except Exception as error:
        remove_remains(plan.experiment)
        if watch.lost is not None:
            raise watch.lost from error
        # The driver may be the first to notice a full disk.
        failure = supervisor.storage_failure or storage_failure(error) or plan.experiment.lost()
        if failure is None:
            raise
        raise _advised(failure) from error
    if supervisor.storage_failure is not None:
        remove_remains(plan.experiment)
        raise _advised(supervisor.storage_failure)


def _scheduler(plan: Plan, job: Job, supervisor: Supervisor) -> Population | PruningScheduler:
    """The rule that compares trials, after replaying the recorded evaluations."""
    spec = plan.space.file.scheduler
    if isinstance(spec, PopulationBasedTraining):
        return Population(spec, _budget(plan), plan.space.sampled, plan.space.file.sample_seed)
    pruner, journal = _pruner(plan), _journal(plan)
    replay(pruner, spec.time_attr, journal.read()[0])
    return PruningScheduler(
        pruner, spec.time_attr, journal, lambda trial: job.trial_of(trial.config).id, supervisor.pruned
    )


def _suggestions(plan: Plan, suggested: list[SearchTrial], job: Job) -> Suggestions:
    """The space's search, with the results of its suggestions so far."""
    begun, scored = [], []
    for earlier in suggested:
        record = read_record(earlier.trial, plan.experiment.trial_folder(earlier.trial.id))
        if record.ending is None:
            begun.append(earlier.params)
        else:
            scored.append((earlier.params, record))
    file = plan.space.file
    # The original seed would repeat the original draws.
    seed = file.sample_seed + len(suggested)
    given = (file.objectives,) if file.objectives else ()
    search = search_class(file.search)(plan.space.sampled, seed, *given)
    for params, record in scored:
        if file.objectives:
            search.tell_objectives(params, last_figures(record.rows, list(file.objectives)))
        else:
            search.tell(params, record.score)
    left = file.samples - len(scored)
    return Suggestions(
        plan.experiment, lambda config: job.trial_of(config).id, search, begun, left, tuple(file.objectives)
    )


def _advised(failure: StorageFailure) -> StorageFailure:
    if isinstance(failure, OwnershipLost):
        return failure
    return StorageFailure(f"{failure}; fix that and continue with --resume")


@contextmanager
def _log_to(path: Path) -> Iterator[None]:
    """Redirect Ray's logs, output and warnings in this process to a file; the console prints what matters."""
    logger = logging.getLogger("ray")
    handlers, level = logger.handlers, logger.level
    file = logging.FileHandler(path, encoding="utf-8")
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logger.handlers = [file]
    logger.setLevel(logging.INFO)
    # Ray warns about settings chosen on purpose, such as a new process for each trial, and prints messages about dead
    # workers without a logger.
    with warnings.catch_warnings(), path.open("a", encoding="utf-8") as log, redirect_stdout(log), redirect_stderr(log):
        warnings.filterwarnings("ignore", category=UserWarning, module=r"ray\.")
        try:
            yield
        finally:
            logger.handlers = handlers
            logger.setLevel(level)
            file.close()


class _StopWhen(Stopper):
    """Ends the experiment once all trials have saved themselves after a request to stop."""

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor

    def __call__(self, trial_id: str, result: dict[str, Any]) -> bool:
        return False

    def stop_all(self) -> bool:
        return self._supervisor.stopped


def _param_space(job: Job, remaining: list[Trial]) -> dict[str, Any]:
    if not remaining:
        return {}  # the search supplies everything
    if not job.population:
        return {"id": tune.grid_search([trial.id for trial in remaining])}
    # Settings of a population's members change: each starts with those last recorded in its folder.
    params = {trial.id: _current_params(job, trial) for trial in remaining}
    return {
        "id": tune.grid_search(list(params)),
        "params": tune.sample_from(lambda spec: params[spec.config["id"]]),
    }


def _current_params(job: Job, trial: Trial) -> dict[str, Any]:
    params = {key: trial.values[key] for key in job.space.sampled}
    written = job.experiment.trial_folder(trial.id) / "config.yaml"
    if not written.is_file():
        return params
    settings = parse_recorded(read_settings(written), str(written)).as_dict()
    return {key: value_at(settings, key) for key in params}


def _pruner(plan: Plan) -> Pruner:
    """The rule that ends trials, without evaluations yet; with several environments, one rule with its own rungs for
    each."""
    spec = plan.space.file.scheduler
    groups = by_environment(plan.trials, lambda trial: trial.environment)
    if len(groups) < 2:
        return spec.pruner(_budget(plan))
    rules = {name: spec.pruner(_budget(plan, trials)) for name, trials in groups.items()}
    return PerEnvironment(rules, {trial.id: trial.environment for trial in plan.trials})


def _budget(plan: Plan, trials: Sequence[Trial] | None = None) -> float:
    """The largest budget of a trial in the scheduler's unit of time, over all trials if none are given; infinite if no
    rule needs it."""
    scheduler = plan.space.file.scheduler
    if not (scheduler.ends_trials or scheduler.exchanges):
        return math.inf  # a user's algorithm need not define its number of env steps
    configs = [trial.config for trial in trials or plan.trials] or extreme_configs(plan.space)
    return longest_budget(plan.space.file, configs)


def _first_suggestion(job: Job) -> Trial:
    """A stand-in with the same model for the trials that a search will suggest."""
    params = {
        key: op.extremes()[0].label if isinstance(op, NamedValues) else op.extremes()[0].value
        for key, op in job.space.sampled.items()
    }
    return job.trial_of({"params": params})


def one_per_kernel_set(trials: Iterable[Trial]) -> list[Trial]:
    """One trial for each combination of model, algorithm and loggers: different models and algorithms need different
    kernels, and missing loggers are reported early. Models that differ in a time constant or the like share kernels."""
    representatives: dict[str, Trial] = {}
    for trial in trials:
        c = trial.config
        physics = _without_numbers(c.physics.model_dump())
        key = (c.env.name, physics, c.evaluation.variant, c.algorithm.name, c.execution)
        representatives.setdefault(repr(key), trial)
    return list(representatives.values())


def _without_numbers(setting: Any) -> Any:
    """A setting, with all numbers but whole ones replaced by whether they are zero: kernels read them from arrays."""
    if isinstance(setting, dict):
        return {name: _without_numbers(part) for name, part in setting.items()}
    if isinstance(setting, list | tuple):
        return [_without_numbers(part) for part in setting]
    return setting != 0.0 if isinstance(setting, float) else setting


def _precompile(plan: Plan, trials: Sequence[Trial]) -> None:
    """Compile the kernels of every distinct model once on every node, so that trials find them in Warp's cache."""
    models = one_per_kernel_set(trials)
    nodes = nodes_for(plan.placement)
    started = time.monotonic()
    print(f"compiling kernels of {len(models)} model(s) on {len(nodes)} node(s) ...", flush=True)
    compile_model = plan.precompile
    assert compile_model is not None

    def task(config: Config, device: str) -> None:
        with tempfile.TemporaryDirectory() as folder:
            compile_model(config, device, Path(folder))

    remote = ray.remote(task)
    pending = [
        remote.options(
            num_cpus=plan.placement.cpus,
            num_gpus=plan.placement.gpus,
            scheduling_strategy=NodeAffinitySchedulingStrategy(node_id=node["NodeID"], soft=False),
        ).remote(trial.config, plan.placement.device)
        for node in nodes
        for trial in models
    ]
    try:
        ray.get(pending)
    except RayTaskError as error:
        if isinstance(error.cause, MskRayError):
            raise error.cause from None
        raise
    print(f"kernels ready after {format_duration(time.monotonic() - started)}", flush=True)
