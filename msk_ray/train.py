"""`python -m msk_ray.train`, and `msk_ray.train(config, ...)`: one trial in this process, without Ray.

The module is callable because `msk_ray.train` has two meanings: the function for users of the library, and this module
once it is imported.
"""

if __name__ == "__main__":
    # Set up before the slow imports.
    from msk_ray import signals

    signals.listen()

import argparse
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from msk_ray.cli import TERMINAL_LOG, Parser, run, surviving_closed_output, typed_command
from msk_ray.compiling import announce_compiling
from msk_ray.config import SET_HELP, Config, load_config
from msk_ray.errors import CheckpointError, ConfigError, StorageError
from msk_ray.experiment.layout import ENVIRONMENT_FILE
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.ownership import Ownership, owned
from msk_ray.experiment.provenance import environment
from msk_ray.files import check_writable, make_folder, write_json
from msk_ray.metrics import SCORE
from msk_ray.progress import ProgressLine, announce
from msk_ray.signals import RESUMABLE, StopRequest, listening
from msk_ray.step.garbage import lasting_imports
from msk_ray.text import printable

if TYPE_CHECKING:
    from msk_ray.training import ParallelTrainer, Trainer

DESCRIPTION = """\
Train one policy with SHAC or another algorithm: one trial, in this process, without Ray.

Writes into the log folder: config.yaml (every setting), env.json (command, commit, versions, device), metrics.jsonl
(one row per epoch), TensorBoard events, and checkpoints/ with the newest two and best.pt, the trained policy with the
highest evaluation score (the untrained policy until the first score)."""

EXAMPLES = """\
  python -m msk_ray.train --config cartpole
  python -m msk_ray.train --config configs/ant.yaml --device cuda:0 --seed 1 --set shac.horizon=32
  python -m msk_ray.train --config ant --set 'shac.horizon={kind: schedule, start: 8, end: 32, epochs: 100}'
  python -m msk_ray.train --config configs/cartpole.yaml --set algorithm.name=ppo
  python -m msk_ray.train --config configs/cartpole.yaml --logdir runs/mine --resume   # after a crash or Ctrl-C
  tensorboard --logdir runs"""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.train", DESCRIPTION, EXAMPLES)
    p.add_argument(
        "--config", type=Path, required=True, metavar="NAME|FILE", help="a config file, or a name in configs/"
    )
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help=SET_HELP)
    p.add_argument("--seed", type=int, help="same as --set trial.seed=N")
    p.add_argument("--device", help="cpu or cuda:N (default: the first GPU, or the CPU if there is none)")
    p.add_argument(
        "--logdir",
        type=Path,
        metavar="DIR",
        help="log folder (default: runs/train/CONFIG_seedN, with --set env.name=.. CONFIG_ENV_seedN)",
    )
    p.add_argument(
        "--resume", action="store_true", help="continue from the newest complete checkpoint in the log folder"
    )
    p.add_argument(
        "--score-at-once",
        action="store_true",
        help="score each policy immediately; by default, several are scored together on a GPU, which is faster",
    )
    p.add_argument(
        "--force",
        action="store_true",
        help="take over the log folder even if its owner seems to be running (check first); that process then stops",
    )
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    overrides = [*args.overrides, *([] if args.seed is None else [f"trial.seed={args.seed}"])]
    config = load_config(args.config, overrides)
    config.check_installed()
    logdir = args.logdir or Path("runs") / "train" / _folder_name(args.config.stem, config, args.overrides)
    _check_logdir(logdir, args.resume)
    logdir = logdir.resolve()
    words = sys.argv if argv is None else [__file__, *argv]
    with listening() as stop, owned(logdir, args.force) as ownership, surviving_closed_output(logdir / TERMINAL_LOG):
        try:
            return _train(config, args, ownership, stop, typed_command(words, "--resume"))
        except KeyboardInterrupt:
            if stop.signal is None or stop.insisted:
                if waiting := _waiting(logdir):
                    print(f"{waiting} not scored yet, so best.pt may be an early one: --resume scores what waits")
                raise
            # Outside the epochs: kernels are still being compiled, or the disk is slow.
            begun = (logdir / "checkpoints").is_dir()
            command = typed_command(words, *(["--resume"] if begun else []))
            print(f"stopped by {stop.signal.name}; continue with: {printable(command)}")
            return RESUMABLE


def _folder_name(stem: str, config: Config, overrides: Sequence[str]) -> str:
    """Of the default log folder: the config file, the environment if --set chooses it, the seed."""
    changed = any(text.partition("=")[0].strip() == "env.name" for text in overrides)
    env = f"_{re.split('[.:]', config.env.name)[-1]}" if changed else ""
    return f"{stem}{env}_seed{config.trial.seed}"


def _check_logdir(logdir: Path, resume: bool) -> None:
    """Raise if the folder holds another trial."""
    if (logdir / "metrics.jsonl").exists() and not resume:
        raise StorageError(
            f"{logdir} already holds a trial: add --resume (in Python resume=True) to continue it, or choose another "
            "--logdir"
        )
    if resume and not (logdir / "checkpoints").is_dir():
        raise StorageError(f"--resume: no trial in {logdir}; leave out --resume to start one")
    if resume:
        check_writable(logdir)
    else:
        make_folder(logdir)


@dataclass(frozen=True)
class TrainingResult:
    """Result of a trial that has run all its epochs."""

    logdir: Path
    """Its folder, with config.yaml, metrics.jsonl and checkpoints/."""
    epochs: int
    """Number of epochs trained."""
    best_score: float
    """Highest evaluation score of the trained policy; -inf if there is none."""
    best_checkpoint: Path
    """Checkpoint of that policy, for `load_policy`; the untrained policy if there is no score."""


def train(
    config: Config,
    logdir: str | Path,
    device: str | None = None,
    *,
    resume: bool = False,
    force: bool = False,
    score_at_once: bool = False,
    on_epoch: Callable[[dict[str, float]], None] | None = None,
) -> TrainingResult:
    """Train one policy in this process, like the command, but without printing.

    To continue an interrupted call from its last checkpoint, repeat it with `resume`.

    Example:
        >>> trained = msk_ray.train(msk_ray.load_config("cartpole"), "runs/mine")
        >>> policy = msk_ray.load_policy(trained.best_checkpoint)

    Args:
        config: every setting, from `load_config`.
        logdir: folder of the trial.
        device: cpu or cuda:N, the first of `execution.gpus`; by default the first GPU, or the CPU if there is none.
        resume: continue from the newest complete checkpoint in `logdir`.
        force: take over the folder even if its owner seems to be running.
        score_at_once: score each policy immediately. By default, several are scored together on a GPU, at most two
            minutes later, and scores are then added to the rows in `metrics.jsonl`.
        on_epoch: called with each epoch's row of metrics.

    Raises:
        StorageError: the folder holds another trial, belongs to another process, or cannot be written.
        CheckpointError: with `resume`, no checkpoint is complete or the newest has other settings.
        RankLost: one of the processes of a trial with several GPUs has died; repeat the call with `resume`.
        DeviceError, UnsupportedModelError, SimulationError: as their messages say.
    """
    if not isinstance(config, Config):
        raise ConfigError(f"config must be a Config, not {type(config).__name__}: write msk_ray.load_config(...)")
    config.check_installed()
    for line in config.unfinished:
        warnings.warn(line, stacklevel=2)
    folder = Path(logdir)
    _check_logdir(folder, resume)
    with owned(folder.resolve(), force) as ownership:
        trainer = _trainer(config, ownership.folder, _choose_device(device), resume, score_at_once)
        if resume:
            for fault in trainer.restore_latest()[1]:
                warnings.warn(f"skipped: {fault}", stacklevel=2)
        try:
            while not trainer.finished:
                ownership.check()
                row = trainer.run_epoch()
                if on_epoch is not None:
                    on_epoch(row)
        finally:
            trainer.close()
    return TrainingResult(trainer.logdir, trainer.epoch, trainer.best_score, trainer.best_checkpoint)


def _choose_device(asked: str | None) -> str:
    """The requested device, else the first GPU, else the CPU; loads torch."""
    # Torch reads this when it is imported: idle threads should sleep, not spin.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with lasting_imports():
        from msk_ray.evaluate.measure import default_device

    return asked or default_device()


def _trainer(
    config: Config, logdir: Path, device: str, resume: bool, score_at_once: bool
) -> "Trainer | ParallelTrainer":
    """A trainer for the trial in `logdir`, before its first epoch."""
    # torch and Warp take seconds to load; a wrong command line should not wait for them.
    from msk_ray.training import MOST_TOGETHER, make_trainer
    from msk_ray.training.checkpoint import newest_valid_checkpoint
    from msk_ray.training.machine import device_name

    if resume:
        newest, faults = newest_valid_checkpoint(logdir / "checkpoints")
        if newest is None and faults:
            raise CheckpointError(
                f"--resume: no checkpoint in {logdir} is complete ({faults[0]}); choose another --logdir to start again"
            )
    trainer = make_trainer(config, logdir, device, 1 if score_at_once or device == "cpu" else MOST_TOGETHER)
    if not resume:
        facts = environment(device_name(device)) | {"deterministic": config.execution.deterministic}
        write_json(logdir / ENVIRONMENT_FILE, facts)
    return trainer


def _train(
    config: Config, args: argparse.Namespace, ownership: Ownership, stop: StopRequest, resume_command: str
) -> int:
    logdir = ownership.folder
    print(
        f"{config.env.name}: {config.trial.epochs} epochs, {config.env.nworld} worlds; log folder {logdir}", flush=True
    )
    for line in config.unfinished:
        print(line)
    device = _choose_device(args.device)
    gpus = config.execution.gpus
    place = device if gpus == 1 else f"{gpus} {'CPU processes' if device == 'cpu' else f'GPUs, the first {device}'}"
    announce_compiling(f"on {place}")
    trainer = _trainer(config, logdir, device, args.resume, args.score_at_once)
    if args.resume:
        path, faults = trainer.restore_latest()
        for fault in faults:
            print(f"skipped: {printable(fault)}")
        print(f"resumed from {path}" if path else "no complete checkpoint yet: starting from the beginning")
    if config.execution.solver_kernels == "auto":
        print(f"constraint solver: {trainer.solver()}")
    if trainer.together > 1:
        print(f"policies are scored {trainer.together} at a time, after two minutes at most (or --score-at-once)")
    elif trainer.epoch == 0:
        announce(f"scoring the first policy in {config.evaluation.nworld} worlds, then training")
    progress = ProgressLine(config.trial.epochs)
    # Loggers flush their rows in any case.
    with stop.deferred(), closing(trainer):
        while not trainer.finished and not stop:
            ownership.check()
            progress.show(trainer.run_epoch())
        progress.close()
        if not trainer.finished:
            ownership.check()
            trainer.save()
            if waiting := _waiting(logdir):
                announce(f"stopping: {waiting} to score first; a second Ctrl-C leaves that to --resume")
            trainer.score_waiting()
        for remark in trainer.remarks():
            print(printable(remark))
    if not trainer.finished:
        assert stop.signal is not None
        command = printable(resume_command)
        print(f"stopped by {stop.signal.name} after epoch {trainer.epoch}; continue with: {command}")
        return RESUMABLE
    if math.isfinite(trainer.best_score):
        untrained = _untrained_score(logdir)
        beside = "" if untrained is None else f" (untrained {untrained:.1f})"
        print(f"best score of a trained policy {trainer.best_score:.1f}{beside}: {trainer.best_checkpoint}")
        if untrained is not None and untrained >= trainer.best_score:
            print("no trained policy scored higher than the first one: by this score, nothing was learned")
    else:
        print(f"no evaluation gave a score; {trainer.best_checkpoint} is the untrained policy")
    print(f"metrics: {logdir / 'metrics.jsonl'}; curves: tensorboard --logdir {logdir}")
    return 0


def _waiting(logdir: Path) -> str:
    """Text on how many policies are waiting to be scored; empty if none."""
    from msk_ray.training.checkpoint import unscored_checkpoints

    count = len(unscored_checkpoints(logdir / "checkpoints"))
    return "" if not count else "1 policy" if count == 1 else f"{count} policies"


def _untrained_score(logdir: Path) -> float | None:
    """The untrained policy's score; None if it was not evaluated."""
    first = next(iter(read_rows(logdir)), {})
    return first.get(SCORE) if first.get("epoch") == 0 else None


class _CallableModule(ModuleType):
    """A module that can be called: `msk_ray.train(config, logdir)`."""

    __call__ = staticmethod(train)


sys.modules[__name__].__class__ = _CallableModule

if __name__ == "__main__":
    sys.exit(run(main))
