"""The command line of `python -m msk_ray.tune`, parsed once into an immutable object."""

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from msk_ray.cli import STORAGE, Parser
from msk_ray.config import SET_HELP
from msk_ray.errors import ConfigError
from msk_ray.experiment.damage import texts
from msk_ray.experiment.manifest import REMEMBERED, Experiment, check_name, default_name, has_begun
from msk_ray.experiment.outcomes import Outcome
from msk_ray.sweep.extend import parse_extension
from msk_ray.sweep.space import find_space, parse_seeds

DESCRIPTION = """\
Run the trials of a search space in parallel, one GPU (or CPU core) each. Score them by deterministic evaluation,
and stop poor ones early.

Writes a folder for each trial to runs/EXPERIMENT/, and at the end summary.json, table.md and report/."""

EXAMPLES = """\
  python -m msk_ray.tune --space cartpole_smoke --cpu               # minutes on two cores
  python -m msk_ray.tune --space ant_ablate --dry-run               # which trials would run?
  python -m msk_ray.tune --space ant_ablate --smoke --cpu           # does everything run?
  python -m msk_ray.tune --space ant_lr --seeds 0-4 --gpus-per-trial 0.5
  python -m msk_ray.tune --space ant_lr --set trial.epochs=100 --name ant_lr_short
  python -m msk_ray.tune --space ant_ablate --no-early-stopping --name ant_ablate_whole   # to compare variants
  python -m msk_ray.tune --space ant_lr --resume                    # after Ctrl-C, a crash or a lost node
  python -m msk_ray.tune --space ant_lr --extend epochs=600         # train a finished experiment for more epochs
  python -m msk_ray.tune --space ant_lr --debug-trial 3             # one trial in this process, without Ray

exit codes: 0 all trials ended, 1 some ended in an error, 2 refused before any work started, 75 stopped on request and
resumable."""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.tune", DESCRIPTION, EXAMPLES)
    p.add_argument("--space", required=True, metavar="NAME|FILE", help="a space file, or a name in tune_spaces/")
    p.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help=f"for all trials: {SET_HELP}",
    )
    p.add_argument("--seeds", metavar="LIST", help="seeds to use instead of the space's, such as 0-4 or 0,3,7")
    p.add_argument(
        "--early-stopping",
        action=argparse.BooleanOptionalAction,
        help="enable or disable stopping by score (asha, median, stop.plateau, stop.target); default: as the "
        "space says, with --resume unchanged",
    )
    p.add_argument(
        "--smoke",
        action="store_true",
        help="run in minutes: every value of every factor, few epochs, no early stopping",
    )
    p.add_argument("--dry-run", action="store_true", help="print the resolved trials and stop")
    p.add_argument(
        "--debug-trial", metavar="K", help="run trial K (number or id of --dry-run) in this process, without Ray"
    )
    where = p.add_argument_group("where and how")
    where.add_argument("--gpus-per-trial", type=float, metavar="G", help="GPUs per trial; below 1, trials share a GPU")
    where.add_argument(
        "--halve-worlds",
        action=argparse.BooleanOptionalAction,
        help="restart a trial that runs out of memory once, with half of its env.nworld (tables mark it); default: as "
        "the space says (resources.halve_worlds_on_oom), with --resume unchanged",
    )
    where.add_argument("--cpu", action="store_true", help="run on CPU cores even if there are GPUs")
    where.add_argument("--max-concurrent", type=int, metavar="N", help="at most N trials at a time")
    where.add_argument(
        "--address",
        metavar="HOST:PORT",
        default=os.environ.get("RAY_ADDRESS") or None,
        help="use a running Ray cluster (default: RAY_ADDRESS) instead of starting Ray; 'auto' finds the "
        "cluster that `ray start` started on this machine",
    )
    where.add_argument("--storage", **STORAGE)
    where.add_argument("--name", help="name of the experiment (default: the space's name)")
    where.add_argument("--resume", action="store_true", help="continue an interrupted experiment")
    where.add_argument(
        "--start-or-resume",
        action="store_true",
        help="start the experiment, or resume it if it exists: for job schedulers that repeat the same command",
    )
    where.add_argument(
        "--force",
        action="store_true",
        help="take over the experiment even if its driver seems to be running (check first); that driver then stops",
    )
    where.add_argument(
        "--extend",
        action="append",
        default=[],
        metavar="KIND=TOTAL",
        help="extend an ended experiment: epochs=N (finished trials continue to N), samples=N or seeds=LIST "
        "(adds trials); values are new totals, not additions",
    )
    where.add_argument(
        "--retry-errored", action="store_true", help="with --resume: retry trials that ended in an error"
    )
    where.add_argument(
        "--retry",
        metavar="OUTCOMES",
        help="with --resume: retry trials with these outcomes, such as nonfinite,diverged",
    )
    return p


@dataclass(frozen=True)
class Options:
    """The options of a sweep."""

    space: Path
    """The space file."""
    path: Path
    """The experiment's folder, absolute; it may not exist yet."""
    overrides: tuple[str, ...] = ()
    """Settings for all trials, `KEY=VALUE`."""
    seeds: str | None = None
    early_stopping: bool | None = None
    """Whether scores may end trials; None: as the space says."""
    halve_worlds: bool | None = None
    """Whether a trial that runs out of memory gets another attempt; None: as the space says."""
    smoke: bool = False
    dry_run: bool = False
    debug_trial: str | None = None
    gpus_per_trial: float | None = None
    cpu: bool = False
    max_concurrent: int | None = None
    address: str | None = None
    """Address of a running Ray cluster."""
    resume: bool = False
    force: bool = False
    extension: Mapping[str, Any] = field(default_factory=dict)
    """Epochs, samples or seeds, as totals."""
    retried: frozenset[Outcome] = frozenset()
    """Outcomes whose trials should continue."""

    @property
    def going_on(self) -> bool:
        """Whether to continue an existing experiment."""
        return self.resume or bool(self.extension)

    def recorded(self) -> Experiment | None:
        """The experiment to continue, if there is one."""
        return Experiment(self.path) if self.going_on and has_begun(self.path) else None

    def remembering(self, experiment: Experiment | None) -> "Options":
        """These options, completed from the experiment's earlier command lines."""
        if experiment is None:
            return self
        known: dict[str, Any] = {
            name: experiment.remembered(name) if now is None else now for name, now in self.remembered().items()
        }
        return replace(self, **known)

    def as_started(self, experiment: Experiment) -> "Options | None":
        """These options, with the trials' settings of the experiment's original command line; None if not recorded."""
        said = experiment.manifest().get("options") or {}
        space, overrides, seeds, smoke = (said.get(name) for name in ("space", "overrides", "seeds", "smoke"))
        if not (isinstance(space, str) and isinstance(overrides, list) and texts(overrides)):
            return None
        if not (isinstance(seeds, str | None) and isinstance(smoke, bool)):
            return None
        return replace(self, space=Path(space), overrides=tuple(overrides), seeds=seeds, smoke=smoke)

    def remembered(self) -> dict[str, bool | None]:
        """Options that an experiment remembers, by name."""
        return {name: getattr(self, name) for name in REMEMBERED}

    def as_data(self) -> dict[str, Any]:
        """As plain data, for the manifest."""
        plain = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(self).items()}
        return plain | {"overrides": list(self.overrides), "retried": sorted(self.retried)}


def read_options(argv: Sequence[str] | None) -> Options:
    """Parse a command line.

    Raises:
        ConfigError: options are incompatible, or the space does not exist.
        StorageError: the experiment's name is invalid.
    """
    args = parser().parse_args(argv)
    space = find_space(args.space)
    name = args.name or default_name(args.space, args.smoke)
    path = (args.storage / check_name(name)).resolve()
    resume = args.resume or (args.start_or_resume and has_begun(path))
    if args.max_concurrent is not None and args.max_concurrent < 1:
        raise ConfigError(f"--max-concurrent {args.max_concurrent}: at least 1")
    retried = _retried(args)
    if retried and not resume:
        raise ConfigError(f"--retry{'-errored' if args.retry_errored else ''} needs --resume")
    if args.smoke and args.early_stopping:
        raise ConfigError("--early-stopping: a smoke run does not end trials by their score; leave out one of the two")
    extension = parse_extension(args.extend)
    if extension and args.smoke:
        raise ConfigError("--extend: a smoke run cannot be extended; leave out --smoke")
    if args.seeds is not None:
        parse_seeds(args.seeds)
    named = {option.name for option in fields(Options)}
    given = {name: value for name, value in vars(args).items() if name in named}
    computed = {"space": space, "path": path, "overrides": tuple(args.overrides), "resume": resume}
    return Options(**given | computed, extension=extension, retried=retried)


def _retried(args: argparse.Namespace) -> frozenset[Outcome]:
    """Outcomes to retry."""
    known = [str(outcome) for outcome in Outcome if outcome is not Outcome.FINISHED]
    names = args.retry.split(",") if args.retry is not None else []
    for name in names:
        if name not in known:
            raise ConfigError(f"--retry {name!r}: write one or more of {','.join(known)}")
    return frozenset(Outcome(name) for name in names) | ({Outcome.ERROR} if args.retry_errored else set())
