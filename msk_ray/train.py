"""`python -m msk_ray.train`: one trial in this process, without Ray. The thing to debug."""

if __name__ == "__main__":
    # Before whatever takes time to load.
    from msk_ray import signals

    signals.listen()

import argparse
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from msk_ray.cli import TERMINAL_LOG, Parser, outliving, run, typed_command
from msk_ray.config import SET_HELP, Config, load_config
from msk_ray.errors import CheckpointError, StorageError
from msk_ray.files import check_writable, make_folder
from msk_ray.ownership import Ownership, owned
from msk_ray.signals import RESUMABLE, StopRequest, listening
from msk_ray.text import printable

DESCRIPTION = """\
Train one policy with SHAC: one trial, in this process, without Ray.

Writes into the log folder: config.yaml (every setting), metrics.jsonl (one row an epoch), TensorBoard events and
checkpoints/ with the newest two and best.pt, the trained policy with the highest evaluation score (until the first
evaluation the untrained one)."""

EXAMPLES = """\
  python -m msk_ray.train --config configs/cartpole.yaml
  python -m msk_ray.train --config configs/ant.yaml --device cuda:0 --seed 1 --set shac.horizon=32
  python -m msk_ray.train --config configs/ant.yaml --set 'shac.horizon={start: 8, end: 32, epochs: 100}'
  python -m msk_ray.train --config configs/cartpole.yaml --logdir runs/mine --resume   # after a crash or Ctrl-C
  tensorboard --logdir runs"""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.train", DESCRIPTION, EXAMPLES)
    p.add_argument("--config", type=Path, required=True, metavar="FILE", help="a file of configs/")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help=SET_HELP)
    p.add_argument("--seed", type=int, help="same as --set trial.seed=N")
    p.add_argument("--device", help="cpu or cuda:N; by default the first GPU, or the CPU if there is none")
    p.add_argument("--logdir", type=Path, metavar="DIR", help="by default runs/train/CONFIG_seedN")
    p.add_argument("--resume", action="store_true", help="go on from the newest whole checkpoint in the log folder")
    p.add_argument(
        "--force",
        action="store_true",
        help="take the log folder over from a process that looks alive, after looking: the other one stops by itself",
    )
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    overrides = [*args.overrides, *([] if args.seed is None else [f"trial.seed={args.seed}"])]
    config = load_config(args.config, overrides)
    logdir = args.logdir or Path("runs") / "train" / f"{args.config.stem}_seed{config.trial.seed}"
    _check_logdir(logdir, args.resume)
    logdir = logdir.resolve()
    words = sys.argv if argv is None else [__file__, *argv]
    with listening() as stop, owned(logdir, args.force) as ownership, outliving(logdir / TERMINAL_LOG):
        try:
            return _train(config, args, ownership, stop, typed_command(words, "--resume"))
        except KeyboardInterrupt:
            if stop.signal is None or stop.insisted:
                raise
            # Not between two epochs: the kernels are not there yet, or the disk is slow.
            begun = (logdir / "checkpoints").is_dir()
            command = typed_command(words, *(["--resume"] if begun else []))
            print(f"stopped by {stop.signal.name}; go on with: {printable(command)}")
            return RESUMABLE


def _check_logdir(logdir: Path, resume: bool) -> None:
    """Refuse to write over another trial."""
    if (logdir / "metrics.jsonl").exists() and not resume:
        raise StorageError(f"{logdir} holds a trial already: add --resume to go on with it, or name another --logdir")
    if resume and not (logdir / "checkpoints").is_dir():
        raise StorageError(f"--resume: no trial in {logdir}; leave --resume out to start one")
    if resume:
        check_writable(logdir)
    else:
        make_folder(logdir)


def _train(
    config: Config, args: argparse.Namespace, ownership: Ownership, stop: StopRequest, resume_command: str
) -> int:
    # Read when torch is imported: threads that wait for work are to sleep, not to spin.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # torch and Warp take seconds to load; a wrong command line should not wait for them.
    import torch

    from msk_ray.progress import Progress
    from msk_ray.training import Trainer
    from msk_ray.training.checkpoint import newest_valid_checkpoint

    logdir = ownership.folder
    if args.resume:
        newest, faults = newest_valid_checkpoint(logdir / "checkpoints")
        if newest is None and faults:
            raise CheckpointError(
                f"--resume: no checkpoint in {logdir} is whole ({faults[0]}); name another --logdir to start anew"
            )
    device = args.device or ("cuda:0" if torch.cuda.is_available() else "cpu")
    print(f"{config.env.name}: {config.trial.epochs} epochs, {config.env.nworld} worlds, on {device}; into {logdir}")
    print("preparing kernels (a first run compiles them, up to a minute) ...", flush=True)
    trainer = Trainer(config, logdir, device)
    if args.resume:
        path, faults = trainer.restore_latest()
        for fault in faults:
            print(f"skipped: {printable(fault)}")
        print(f"resumed from {path}" if path else "no whole checkpoint yet: starting anew")
    progress = Progress(config.trial.epochs, trainer.epoch)
    with stop.deferred():
        while not trainer.finished and not stop:
            ownership.check()
            progress.show(trainer.run_epoch())
        progress.close()
        if not trainer.finished:
            ownership.check()
            trainer.save()
            trainer.close()
            assert stop.signal is not None
            print(f"stopped by {stop.signal.name} after epoch {trainer.epoch}; go on with: {printable(resume_command)}")
            return RESUMABLE
        trainer.close()
    if math.isfinite(trainer.best_score):
        print(f"best evaluation score {trainer.best_score:.1f}: {trainer.best_checkpoint}")
    else:
        print(f"no evaluation gave a score; {trainer.best_checkpoint} is the untrained policy")
    print(f"metrics: {logdir / 'metrics.jsonl'}; curves: tensorboard --logdir {logdir}")
    return 0


if __name__ == "__main__":
    sys.exit(run(main))
