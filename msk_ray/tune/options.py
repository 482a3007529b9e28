"""The command line of `python -m msk_ray.tune`, read once into an object that nothing changes afterwards."""

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from msk_ray.cli import Parser
from msk_ray.config import SET_HELP
from msk_ray.errors import ConfigError
from msk_ray.experiment.manifest import Experiment, check_name, has_begun
from msk_ray.experiment.outcomes import Outcome
from msk_ray.sweep.extend import parse_extension
from msk_ray.sweep.space import find_space, parse_seeds

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
        help="try a trial that runs out of memory once more, with half of its env.nworld, and say so in all tables; "
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


@dataclass(frozen=True)
class Options:
    """What was asked for."""

    space: Path
    """The space's file."""
    path: Path
    """The experiment's folder, absolute; it need not be there."""
    overrides: tuple[str, ...] = ()
    """Settings of all trials, `KEY=VALUE`."""
    seeds: str | None = None
    early_stopping: bool | None = None
    """Whether scores end trials; None as the space says."""
    halve_worlds: bool | None = None
    """Whether a trial that runs out of memory gets another attempt; None as the space says."""
    smoke: bool = False
    dry_run: bool = False
    debug_trial: str | None = None
    gpus_per_trial: float | None = None
    cpu: bool = False
    max_concurrent: int | None = None
    address: str | None = None
    """Of a running Ray cluster."""
    resume: bool = False
    force: bool = False
    extension: Mapping[str, Any] = field(default_factory=dict)
    """Epochs, samples or seeds, as totals."""
    retried: frozenset[Outcome] = frozenset()
    """Outcomes whose trials are to go on."""

    @property
    def going_on(self) -> bool:
        """Whether an experiment is to go on that there is already."""
        return self.resume or bool(self.extension)

    def recorded(self) -> Experiment | None:
        """The experiment to go on with, if there is one."""
        return Experiment(self.path) if self.going_on and has_begun(self.path) else None

    def remembering(self, experiment: Experiment | None) -> "Options":
        """These options with what was said on the command lines of an experiment before, where nothing is said now."""
        if experiment is None:
            return self
        known = {name: experiment.said(name) if now is None else now for name, now in self.remembered().items()}
        return replace(self, halve_worlds=known["halve_worlds"], early_stopping=known["early_stopping"])

    def remembered(self) -> dict[str, bool | None]:
        """Those of the options that an experiment remembers, by name."""
        return {"halve_worlds": self.halve_worlds, "early_stopping": self.early_stopping}

    def as_data(self) -> dict[str, Any]:
        """As plain data, for the manifest."""
        plain = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(self).items()}
        return plain | {"overrides": list(self.overrides), "retried": sorted(self.retried)}


def read_options(argv: Sequence[str] | None) -> Options:
    """What a command line asks for.

    Raises:
        ConfigError: options that do not go together, or a space that is not there.
        StorageError: a name that no experiment can have.
    """
    args = parser().parse_args(argv)
    space = find_space(args.space)
    name = args.name or space.stem + ("-smoke" if args.smoke else "")
    path = (args.storage / check_name(name)).resolve()
    resume = args.resume or (args.start_or_resume and has_begun(path))
    if args.max_concurrent is not None and args.max_concurrent < 1:
        raise ConfigError(f"--max-concurrent {args.max_concurrent}: at least 1")
    retried = _retried(args)
    if retried and not resume:
        raise ConfigError(f"--retry{'-errored' if args.retry_errored else ''} goes with --resume")
    if args.smoke and args.early_stopping:
        raise ConfigError("--early-stopping: a smoke run ends no trial by its score; leave one of them out")
    extension = parse_extension(args.extend)
    if extension and args.smoke:
        raise ConfigError("--extend: a smoke run has nothing to extend; leave --smoke out")
    if args.seeds is not None:
        parse_seeds(args.seeds)
    return Options(
        space=space,
        path=path,
        overrides=tuple(args.overrides),
        seeds=args.seeds,
        early_stopping=args.early_stopping,
        halve_worlds=args.halve_worlds,
        smoke=args.smoke,
        dry_run=args.dry_run,
        debug_trial=args.debug_trial,
        gpus_per_trial=args.gpus_per_trial,
        cpu=args.cpu,
        max_concurrent=args.max_concurrent,
        address=args.address,
        resume=resume,
        force=args.force,
        extension=extension,
        retried=retried,
    )


def _retried(args: argparse.Namespace) -> frozenset[Outcome]:
    """The outcomes whose trials are to be tried again."""
    known = [str(outcome) for outcome in Outcome if outcome is not Outcome.FINISHED]
    names = args.retry.split(",") if args.retry is not None else []
    for name in names:
        if name not in known:
            raise ConfigError(f"--retry {name!r}: write one or more of {','.join(known)}")
    return frozenset(Outcome(name) for name in names) | ({Outcome.ERROR} if args.retry_errored else set())
