"""`python -m msk_ray.tune`: an experiment of many trials with Ray Tune, each on GPUs, a share of one, or CPUs."""

if __name__ == "__main__":
    # Set up before the slow imports.
    from msk_ray import signals

    signals.listen()

import contextlib
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from msk_ray.cli import TERMINAL_LOG, run, surviving_closed_output
from msk_ray.config import Config, combine, dump_yaml, parse_overrides
from msk_ray.config.packages import require
from msk_ray.errors import ClusterLost, ConfigError, MskRayError
from msk_ray.experiment.manifest import Experiment, own
from msk_ray.experiment.outcomes import read_ending
from msk_ray.experiment.trial import Trial
from msk_ray.files import make_folder
from msk_ray.signals import RESUMABLE, StopRequest, listening
from msk_ray.sweep import opening
from msk_ray.sweep.budget import extreme_configs
from msk_ray.sweep.extend import extended_space
from msk_ray.sweep.search import search_class
from msk_ray.sweep.search_trials import recover
from msk_ray.sweep.smoke import shrink, without_early_stopping
from msk_ray.sweep.space import Space, parse_space, read_space
from msk_ray.sweep.trials import find_trial, resolve_trials
from msk_ray.text import printable, printable_lines
from msk_ray.text_table import text_table
from msk_ray.tune.devices import Placement, check_threads, processes_of
from msk_ray.tune.options import Options, read_options


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    options = read_options(argv)
    recorded = options.recorded()
    options = options.remembering(recorded)
    space = _read_space(options, (recorded.extension() if recorded is not None else {}) | dict(options.extension))
    if options.extension and (space.file.searches or space.file.scheduler.exchanges):
        kind = space.file.search if space.file.searches else space.file.scheduler.kind
        raise ConfigError(f"--extend: {kind} cannot continue a recorded experiment; pass another --name")
    space, trials = _trials_of(options, space)
    if options.dry_run:
        _print_trials(space, trials)
        return 0
    if options.debug_trial is not None:
        return _debug(options, space, find_trial(trials, options.debug_trial))
    return _run(options, space, trials, recorded)


def _trials_of(options: Options, space: Space) -> tuple[Space, list[Trial]]:
    """The space and its trials, smaller for a smoke run."""
    trials = _resolve(space)
    if not options.smoke:
        return space, trials
    return without_early_stopping(space), shrink(space, trials) if trials else []


def _resolve(space: Space) -> list[Trial]:
    """The space's trials; none for a search, whose known settings are validated instead.

    Raises:
        ConfigError: the space is invalid, or a package is missing, which would otherwise show up after Ray has started.
    """
    if space.file.searches:
        require(search_class(space.file.search).packages, f"search: {space.file.search}")
        configs = extreme_configs(space)
        _check_all(configs, space)
        if "execution.gpus" in space.sampled:
            raise ConfigError("execution.gpus: all trials of an experiment have the same number: write one number")
        return []
    trials = resolve_trials(space)
    _check_all([trial.config for trial in trials], space)
    _processes(space, trials)
    return trials


def _check_all(configs: Sequence[Config], space: Space) -> None:
    """Raise if a trial needs a package that this machine lacks, or more threads than it gets."""
    for config in configs:
        config.check_installed()
    check_threads(configs, space.file.resources)


def _processes(space: Space, trials: list[Trial]) -> int:
    """`execution.gpus` of the trials, which are not known yet if a search suggests them."""
    return processes_of([trial.config for trial in trials] or extreme_configs(space))


def _read_space(options: Options, extension: Mapping[str, Any]) -> Space:
    """The space with the command line's changes merged in, validated again as a whole."""
    path = options.space
    data = read_space(path)
    changes = parse_overrides(options.overrides)
    parameters = data.get("parameters")
    for key in changes:
        if isinstance(parameters, dict) and key in parameters:
            raise ConfigError(f"--set {key}: the space varies it; edit {path.name}, or set another key")
    if changes:
        overrides = data.get("overrides") or {}
        if isinstance(overrides, dict):  # otherwise validation reports it
            data["overrides"] = combine(overrides, changes.items())
    if options.halve_worlds is not None:
        resources = data.get("resources") or {}
        if isinstance(resources, dict):  # otherwise validation reports it
            data["resources"] = {**resources, "halve_worlds_on_oom": options.halve_worlds}
    if options.seeds is not None:
        data["seeds"] = options.seeds
    space = parse_space(extended_space(data, extension), path)
    if options.early_stopping is False:
        if space.file.scheduler.exchanges:
            raise ConfigError(
                f"--no-early-stopping: in {path.name} trials continue from each other ({space.file.scheduler.kind}); "
                "leave it out, or give --early-stopping if the experiment remembers it"
            )
        space = without_early_stopping(space)
    return space


def _print_trials(space: Space, trials: list[Trial]) -> None:
    width = shutil.get_terminal_size((120, 24)).columns
    print(printable_lines(space.file.question.strip()) + "\n")
    if space.file.searches:
        print(f"{space.file.samples} trials, suggested by {space.file.search} as results come in, over:")
        print(dump_yaml(space.file.parameters), end="")
    else:
        print(text_table(("#", "id", "changed", "seed", "epochs"), _rows(trials), width))
    print(
        f"\n{len(trials) or space.file.samples} trials · scheduler {space.file.scheduler.kind} · "
        f"base {printable(space.file.base)}"
    )


def _rows(trials: Sequence[Trial]) -> list[tuple[str, ...]]:
    """Print the resolved trials."""
    return [(str(t.index), t.id, t.variant, str(t.seed), str(t.epochs)) for t in trials]


def _debug(options: Options, space: Space, trial: Trial) -> int:
    """Run one trial in this process, in a separate folder."""
    from msk_ray.experiment.records import read_record
    from msk_ray.tune.devices import local_gpus
    from msk_ray.tune.trial_run import Hooks, make_trainer, run_trial

    folder = (options.path.parent / "debug" / f"{space.name}_{trial.id}_{time.strftime('%Y%m%d_%H%M%S')}").resolve()
    make_folder(folder)
    device = "cpu" if options.cpu or local_gpus() == 0 else "cuda:0"
    where = printable(f"{trial.variant} seed={trial.seed} on {device}; into {folder}")
    print(f"trial {trial.index} ({trial.id}): {where}", flush=True)
    hooks = Hooks(
        on_evaluation=lambda e, ended, trainer: print(
            f"epoch {e.epoch}/{trial.epochs}  score {e.score:.5g}", flush=True
        )
    )
    ending = run_trial(trial, folder, device, space.file.stop, make_trainer, hooks)
    assert ending is not None  # there is no pause hook
    print(f"{ending.outcome}: {printable(ending.why)}")
    return 1 if read_record(trial, folder).errored else 0


def _run(
    options: Options,
    space: Space,
    trials: list[Trial],
    recorded: Experiment | None,
) -> int:
    path = options.path
    with contextlib.ExitStack() as stack, listening() as stop:
        if options.going_on:
            ownership = stack.enter_context(own(path, new=False, force=options.force))
            experiment, trials = _go_on(options, space, trials, recorded)
        # ray takes seconds to load; a wrong command line should not wait for them.
        from msk_ray.tune import driver, session
        from msk_ray.tune.devices import choose_placement, local_gpus
        from msk_ray.tune.finish import finish, write_report

        resources, processes = space.file.resources, _processes(space, trials)

        def place(gpus: int) -> Placement:
            return choose_placement(resources, options.gpus_per_trial, options.cpu, gpus, processes)

        if options.address is None:
            placement = place(0 if options.cpu else local_gpus())  # counting them loads torch
        if not options.going_on:
            ownership = stack.enter_context(own(path, new=True, force=options.force))
            experiment = opening.create(path, space, trials, options.as_data())
        stack.enter_context(surviving_closed_output(path / TERMINAL_LOG))
        try:
            with session.ray_session(options.address):
                if options.address is not None:
                    placement = place(session.cluster_gpus(processes))
                if not placement.gpus and not options.cpu:
                    print("no GPU found: trials run on CPU cores")
                limit = options.max_concurrent or resources.max_concurrent
                plan = driver.Plan(experiment, space, trials, placement, limit, ownership=ownership)
                completed = driver.run_trials(plan)
            ownership.check(now=True)
            errors = finish(experiment)
            if not completed:
                return _stopped(stop, experiment)
            write_report(experiment)
        except KeyboardInterrupt:
            # While Ray starts, kernels are compiled or the report is written, there is nothing to save.
            if stop.signal is None or stop.insisted:
                raise
            return _stopped(stop, experiment)
        except ClusterLost:
            print(f"continue with: {printable(experiment.resume_command())}", flush=True)
            raise
    return 1 if errors else 0


def _go_on(
    options: Options,
    space: Space,
    trials: list[Trial],
    recorded: Experiment | None,
) -> tuple[Experiment, list[Trial]]:
    """The experiment to continue, and its recorded trials; none if a search suggests them."""
    searching = space.file.searches
    another_rule = recorded is not None and options.early_stopping != recorded.remembered("early_stopping")
    if recorded is not None and not another_rule:
        opening.check_scheduler(recorded, space)
    experiment = opening.reopen(
        options.path,
        None if searching else trials,
        options.extension,
        None if recorded is None else lambda: _as_started(options, recorded),
    )
    if searching:
        # A search's trials enter the manifest only at the end.
        experiment.set_trials(made.trial for made in recover(experiment, space))
    else:
        # As recorded: with their original ids and extended epochs.
        trials = experiment.trials()
    experiment.clear_endings(options.retried)
    if another_rule:
        opening.write_space(experiment, space)
    if options.early_stopping is False:
        _name_stopped(experiment)
    experiment.remember(**options.remembered())
    return experiment, trials


def _as_started(options: Options, recorded: Experiment) -> list[Trial]:
    """Trials that the experiment's original command line would give now; none if it would be refused."""
    original = options.as_started(recorded)
    try:
        return [] if original is None else _trials_of(original, _read_space(original, recorded.extension()))[1]
    except MskRayError:
        return []


def _stopped(stop: StopRequest, experiment: Experiment) -> int:
    by = "on request" if stop.signal is None else f"by {stop.signal.name}"
    print(f"stopped {by}; continue with: {printable(experiment.resume_command())}")
    return RESUMABLE


def _name_stopped(experiment: Experiment) -> None:
    """Print that trials stopped before --no-early-stopping stay stopped, and how to continue them."""
    endings = [read_ending(experiment.trial_folder(trial.id)) for trial in experiment.trials()]
    stopped = [ending.outcome for ending in endings if ending is not None and ending.cut]
    if stopped:
        names = ",".join(sorted(set(stopped)))
        print(f"still stopped early: {len(stopped)} trials; --retry {names} lets them continue")


if __name__ == "__main__":
    sys.exit(run(main))
