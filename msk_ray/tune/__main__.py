"""`python -m msk_ray.tune`: an experiment of many trials, one GPU each, with Ray Tune."""

if __name__ == "__main__":
    # Before whatever takes time to load.
    from msk_ray import signals

    signals.listen()

import argparse
import contextlib
import os
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msk_ray.cli import TERMINAL_LOG, Parser, outliving, run
from msk_ray.config import SET_HELP, combine, dump_yaml, parse_overrides
from msk_ray.errors import ConfigError
from msk_ray.experiment.manifest import REMEMBERED, Experiment, check_name, has_begun, own
from msk_ray.experiment.outcomes import Outcome, read_ending
from msk_ray.experiment.trial import Trial
from msk_ray.files import make_folder
from msk_ray.signals import RESUMABLE, StopRequest, listening
from msk_ray.sweep import opening
from msk_ray.sweep.budget import extreme_configs
from msk_ray.sweep.extend import extended_space, parse_extension
from msk_ray.sweep.search_trials import recover
from msk_ray.sweep.smoke import shrink, without_early_stopping
from msk_ray.sweep.space import Space, find_space, parse_seeds, parse_space, read_space
from msk_ray.sweep.trials import find_trial, resolve_trials
from msk_ray.text import printable, printable_lines
from msk_ray.text_table import text_table
from msk_ray.tune.devices import check_threads

DESCRIPTION = """\
Run a search space: many trials side by side, one GPU (or CPU core) each, scored by deterministic evaluation,
the hopeless ones stopped early.

Writes runs/EXPERIMENT/: the trials' folders, and at the end summary.json, table.md and report/."""

EXAMPLES = """\
  python -m msk_ray.tune --space cartpole_smoke --cpu               # minutes on two cores
  python -m msk_ray.tune --space ant_ablate --dry-run               # which trials would run?
  python -m msk_ray.tune --space ant_ablate --smoke --cpu           # does all of it run at all?
  python -m msk_ray.tune --space ant_lr --seeds 0-4 --gpus-per-trial 0.5
  python -m msk_ray.tune --space ant_lr --set trial.epochs=100 --name ant_lr_short
  python -m msk_ray.tune --space ant_ablate --no-early-stopping --name ant_ablate_whole   # to rank what is varied
  python -m msk_ray.tune --space ant_lr --resume                    # after Ctrl-C, a crash or a lost node
  python -m msk_ray.tune --space ant_lr --extend epochs=600         # it has ended; go on to more epochs
  python -m msk_ray.tune --space ant_lr --debug-trial 3             # that trial alone, here, without Ray

exit codes: 0 all trials ended, 1 some ended in an error, 2 refused before any work began, 75 stopped on request and
resumable."""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.tune", DESCRIPTION, EXAMPLES)
    p.add_argument("--space", required=True, metavar="NAME|FILE", help="a file, or a name in tune_spaces/")
    p.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help=f"of all trials: {SET_HELP}",
    )
    p.add_argument("--seeds", metavar="LIST", help="seeds instead of the space's, such as 0-4 or 0,3,7")
    p.add_argument(
        "--early-stopping",
        action=argparse.BooleanOptionalAction,
        help="whether scores end trials (asha, median, stop.plateau, stop.target) as the space says, or all run to "
        "their end; with --resume as before",
    )
    p.add_argument(
        "--smoke",
        action="store_true",
        help="shrink to minutes: every value of every factor, few epochs, no early stopping",
    )
    p.add_argument("--dry-run", action="store_true", help="print the resolved trials and stop")
    p.add_argument("--debug-trial", metavar="K", help="run trial K (number or id of --dry-run) here, without Ray")
    where = p.add_argument_group("where and how")
    where.add_argument("--gpus-per-trial", type=float, metavar="G", help="GPUs a trial; below 1, trials share one")
    where.add_argument(
        "--halve-worlds",
        action=argparse.BooleanOptionalAction,
        help="start a trial that runs out of memory anew, once, with half of its env.nworld, and say so in all tables; "
        "by default as the space says (resources.halve_worlds_on_oom), with --resume as before",
    )
    where.add_argument("--cpu", action="store_true", help="run on CPU cores even if there are GPUs")
    where.add_argument("--max-concurrent", type=int, metavar="N", help="at most N trials at once")
    where.add_argument(
        "--address",
        metavar="HOST:PORT",
        default=os.environ.get("RAY_ADDRESS") or None,
        help="use a running Ray cluster, by default the one RAY_ADDRESS names, instead of starting one; 'auto' finds "
        "what `ray start` began here",
    )
    where.add_argument("--storage", type=Path, default=Path("runs"), metavar="DIR", help="by default runs/")
    where.add_argument("--name", help="the experiment's name; by default the space's")
    where.add_argument("--resume", action="store_true", help="go on with an experiment that was interrupted")
    where.add_argument(
        "--start-or-resume",
        action="store_true",
        help="--resume if the experiment has begun, start it if not: for schedulers that run the same command again",
    )
    where.add_argument(
        "--force",
        action="store_true",
        help="take the experiment over from a driver that looks alive, after looking: the other one stops by itself",
    )
    where.add_argument(
        "--extend",
        action="append",
        default=[],
        metavar="KIND=TOTAL",
        help="go on with an experiment that has ended, with more: epochs=N (those that ran to their end go on to N), "
        "samples=N or seeds=LIST (new trials beside the old ones); totals, not additions",
    )
    where.add_argument(
        "--retry-errored", action="store_true", help="with --resume: try trials again that ended in an error"
    )
    where.add_argument(
        "--retry",
        metavar="OUTCOMES",
        help="the same for other outcomes, such as nonfinite,diverged: from their newest checkpoint",
    )
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    if args.start_or_resume:
        args.resume = args.resume or has_begun(_experiment_path(args))
    if args.max_concurrent is not None and args.max_concurrent < 1:
        raise ConfigError(f"--max-concurrent {args.max_concurrent}: at least 1")
    retried = _retried(args)
    if retried and not args.resume:
        raise ConfigError(f"--retry{'-errored' if args.retry_errored else ''} goes with --resume")
    if args.smoke and args.early_stopping:
        raise ConfigError("--early-stopping: a smoke run ends no trial by its score; leave one of them out")
    extension = parse_extension(args.extend)
    if extension and args.smoke:
        raise ConfigError("--extend: a smoke run has nothing to extend; leave --smoke out")
    recorded = _recorded(args)
    if recorded is not None:
        for option in REMEMBERED:
            if getattr(args, option) is None:
                setattr(args, option, recorded.said(option))
    space = _read_space(args, (recorded.extension() if recorded is not None else {}) | extension)
    if extension and (space.file.search == "optuna" or space.file.scheduler.kind == "pbt"):
        raise ConfigError("--extend: optuna and pbt cannot go on from a recorded experiment; pass another --name")
    trials = _resolve(space)
    if args.smoke:
        trials = shrink(space, trials) if trials else []
        space = without_early_stopping(space)
    if args.dry_run:
        _print_trials(space, trials)
        return 0
    if args.debug_trial is not None:
        return _debug(args, space, find_trial(trials, args.debug_trial))
    return _run(args, space, trials, extension, recorded)


def _resolve(space: Space) -> list[Trial]:
    """The space's trials; none of a search, whose settings are checked as far as they are known."""
    if space.file.search == "optuna":
        check_threads(extreme_configs(space), space.file.resources)
        return []
    trials = resolve_trials(space)
    check_threads((trial.config for trial in trials), space.file.resources)
    return trials


def _retried(args: argparse.Namespace) -> set[Outcome]:
    """The outcomes whose trials are to be tried again."""
    known = [str(outcome) for outcome in Outcome if outcome is not Outcome.FINISHED]
    names = args.retry.split(",") if args.retry is not None else []
    for name in names:
        if name not in known:
            raise ConfigError(f"--retry {name!r}: write one or more of {','.join(known)}")
    return {Outcome(name) for name in names} | ({Outcome.ERROR} if args.retry_errored else set())


def _experiment_path(args: argparse.Namespace) -> Path:
    name: str = args.name or find_space(args.space).stem + ("-smoke" if args.smoke else "")
    storage: Path = args.storage
    return (storage / check_name(name)).resolve()


def _recorded(args: argparse.Namespace) -> Experiment | None:
    """The experiment to go on with: what was said on its command lines before, its space file does not know."""
    experiment = Experiment(_experiment_path(args))
    going_on = (args.resume or args.extend) and has_begun(experiment.path)
    return experiment if going_on else None


def _read_space(args: argparse.Namespace, extension: Mapping[str, Any]) -> Space:
    """The space with the command line's changes laid over it, checked again as a whole."""
    path = find_space(args.space)
    data = read_space(path)
    changes = parse_overrides(args.overrides)
    parameters = data.get("parameters")
    for key in changes:
        if isinstance(parameters, dict) and key in parameters:
            raise ConfigError(f"--set {key}: the space varies it; edit {path.name}, or set another key")
    if changes:
        overrides = data.get("overrides") or {}
        if isinstance(overrides, dict):  # else the space is refused for that
            data["overrides"] = combine(overrides, changes.items())
    if args.halve_worlds is not None:
        resources = data.get("resources") or {}
        if isinstance(resources, dict):  # else the space is refused for that
            data["resources"] = {**resources, "halve_worlds_on_oom": args.halve_worlds}
    if args.seeds is not None:
        parse_seeds(args.seeds)
        data["seeds"] = args.seeds
    space = parse_space(extended_space(data, extension), path)
    if args.early_stopping is False:
        if space.file.scheduler.kind == "pbt":
            raise ConfigError(
                f"--no-early-stopping: in {path.name} trials go on from each other (pbt); leave it out, or say "
                "--early-stopping if the experiment remembers it"
            )
        space = without_early_stopping(space)
    return space


def _print_trials(space: Space, trials: list[Trial]) -> None:
    width = shutil.get_terminal_size((120, 24)).columns
    print(printable_lines(space.file.question.strip()) + "\n")
    if space.file.search == "optuna":
        print(f"{space.file.samples} trials, chosen by optuna as results come in, over:")
        print(dump_yaml(space.file.parameters), end="")
    else:
        print(text_table(("#", "id", "changed", "seed", "epochs"), _rows(trials), width))
    print(
        f"\n{len(trials) or space.file.samples} trials · scheduler {space.file.scheduler.kind} · "
        f"base {printable(space.file.base)}"
    )


def _rows(trials: Sequence[Trial]) -> list[tuple[str, ...]]:
    """The resolved trials before they run."""
    return [(str(t.index), t.id, t.variant, str(t.seed), str(t.epochs)) for t in trials]


def _debug(args: argparse.Namespace, space: Space, trial: Trial) -> int:
    """One trial in this process, in a folder of its own."""
    from msk_ray.experiment.results import read_record
    from msk_ray.training import Trainer
    from msk_ray.tune.devices import local_gpus
    from msk_ray.tune.trial_run import Hooks, run_trial

    folder = (args.storage / "debug" / f"{space.name}_{trial.id}_{time.strftime('%Y%m%d_%H%M%S')}").resolve()
    make_folder(folder)
    device = "cpu" if args.cpu or local_gpus() == 0 else "cuda:0"
    where = printable(f"{trial.variant} seed={trial.seed} on {device}; into {folder}")
    print(f"trial {trial.index} ({trial.id}): {where}", flush=True)
    hooks = Hooks(
        on_evaluation=lambda e, ended, trainer: print(
            f"epoch {e.epoch}/{trial.epochs}  score {e.score:.5g}", flush=True
        )
    )
    ending = run_trial(trial, folder, device, space.file.stop, Trainer, hooks)
    assert ending is not None  # nobody pauses it
    print(f"{ending.outcome}: {printable(ending.why)}")
    return 1 if read_record(trial, folder).errored else 0


def _run(
    args: argparse.Namespace,
    space: Space,
    trials: list[Trial],
    extension: Mapping[str, Any],
    recorded: Experiment | None,
) -> int:
    path = _experiment_path(args)
    going_on = args.resume or bool(extension)
    with contextlib.ExitStack() as stack, listening() as stop:
        if going_on:
            ownership = stack.enter_context(own(path, new=False, force=args.force))
            experiment, trials = _go_on(args, space, trials, extension, recorded)
        # ray and torch take seconds to load; a wrong command line should not wait for them.
        from msk_ray.tune import driver, session
        from msk_ray.tune.devices import choose_placement, local_gpus
        from msk_ray.tune.finish import finish, write_report

        if args.address is None:
            placement = choose_placement(space.file.resources, args.gpus_per_trial, args.cpu, local_gpus())
        if not going_on:
            ownership = stack.enter_context(own(path, new=True, force=args.force))
            experiment = opening.create(path, space, trials, _options(args))
        stack.enter_context(outliving(path / TERMINAL_LOG))
        try:
            with session.ray_session(args.address):
                if args.address is not None:
                    placement = choose_placement(
                        space.file.resources, args.gpus_per_trial, args.cpu, session.cluster_gpus()
                    )
                if not placement.gpus and not args.cpu:
                    print("no GPU here: trials run on CPU cores")
                limit = args.max_concurrent or space.file.resources.max_concurrent
                plan = driver.Plan(experiment, space, trials, placement, limit, ownership=ownership)
                completed = driver.run_trials(plan)
            ownership.check(now=True)
            errors = finish(experiment)
            if not completed:
                return _stopped(stop, experiment)
            write_report(experiment)
        except KeyboardInterrupt:
            # Where there is nothing to save: Ray starts, kernels are compiled, the report is written.
            if stop.signal is None or stop.insisted:
                raise
            return _stopped(stop, experiment)
    return 1 if errors else 0


def _go_on(
    args: argparse.Namespace,
    space: Space,
    trials: list[Trial],
    extension: Mapping[str, Any],
    recorded: Experiment | None,
) -> tuple[Experiment, list[Trial]]:
    """The experiment to go on with, and its trials as recorded; none where a search makes them up."""
    searching = space.file.search == "optuna"
    another_rule = recorded is not None and args.early_stopping != recorded.said("early_stopping")
    if recorded is not None and not another_rule:
        opening.check_scheduler(recorded, space)
    experiment = opening.reopen(_experiment_path(args), None if searching else trials, extension)
    if searching:
        # Else the manifest learns of them only at the end.
        experiment.set_trials(made.trial for made in recover(experiment, space))
    else:
        # As recorded: with the ids they began with, and the epochs they were extended to.
        trials = experiment.trials()
    experiment.clear_endings(_retried(args))
    if another_rule:
        opening.write_space(experiment, space)
    if args.early_stopping is False:
        _name_stopped(experiment)
    experiment.say(**{option: getattr(args, option) for option in REMEMBERED})
    return experiment, trials


def _stopped(stop: StopRequest, experiment: Experiment) -> int:
    by = "on request" if stop.signal is None else f"by {stop.signal.name}"
    print(f"stopped {by}; go on with: {printable(experiment.resume_command())}")
    return RESUMABLE


def _name_stopped(experiment: Experiment) -> None:
    """Say that trials stopped before --no-early-stopping was said stay stopped, and what lets them go on."""
    endings = [read_ending(experiment.trial_folder(trial.id)) for trial in experiment.trials()]
    stopped = [ending.outcome for ending in endings if ending is not None and ending.cut]
    if stopped:
        names = ",".join(sorted(set(stopped)))
        print(f"stopped early before, and left so: {len(stopped)} trials; --retry {names} lets them go on")


def _options(args: argparse.Namespace) -> dict[str, Any]:
    return {key: str(value) if isinstance(value, Path) else value for key, value in vars(args).items()}


if __name__ == "__main__":
    sys.exit(run(main))
