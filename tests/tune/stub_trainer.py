"""A trainer of milliseconds: its score rises towards a height set by the learning rate; some settings misbehave.

Which way is chosen by `env.reward.cart_position_penalty`: 1 kills its own process once, 2 gives NaN, 3 raises
SimulationError, 4 raises an unforeseen error every time, 5 hangs once, 6 finds the disk full once, 7 runs out of
memory, 8 does so with more than `ROOM` worlds, 9 does so before its first epoch, 10 too, and kills its own process once
when it has begun with fewer, 11 and 12 exit with 3 and with 0, 13 raises KeyboardInterrupt, 14 has a connection broken
once. Anything else trains.

While the file named by the environment variable `STUB_HOLD` exists, no trial gets past epoch `HELD_AT`, unless its
experiment is asked to stop.
"""

import errno
import json
import math
import os
import signal
import sys
import time
from collections.abc import Collection
from pathlib import Path

from msk_ray.config import Config, dump_yaml
from msk_ray.errors import CheckpointError, Failure, SimulationError

BEHAVIOUR = "env.reward.cart_position_penalty"
KILL, NAN, SIMULATION_ERROR, BUG, HANG, FULL_DISK, MEMORY = 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0
LATE_CROWD, CROWD, DOOMED_CROWD = 8.0, 9.0, 10.0
EXIT, EXIT_ZERO, INTERRUPT, BROKEN_CONNECTION = 11.0, 12.0, 13.0, 14.0
MISBEHAVE_AT = 5
HELD_AT = 10
ROOM = 4
"""Worlds that fit."""


class StubTrainer:
    """Same surface as `msk_ray.training.Trainer`."""

    seconds_per_epoch = 0.02
    members = 1
    """At epoch `HELD_AT`, a trial waits until so many of its experiment have come as far."""
    until_moved = False
    """Once a trial of this experiment has been given another's state, all go to their last epoch at once."""

    def __init__(self, config: Config, logdir: Path, device: str) -> None:
        self.config, self.logdir, self.device = config, logdir, device
        self.epoch = 0
        self.best_score = -math.inf
        (logdir / "checkpoints").mkdir(parents=True, exist_ok=True)
        (logdir / "config.yaml").write_text(dump_yaml(config.as_dict()))
        self.behaviour = getattr(config.env.reward, "cart_position_penalty", None)
        with (logdir / "processes").open("a") as file:
            file.write(f"{os.getpid()}\n")
        if self.behaviour in (CROWD, DOOMED_CROWD) and config.env.nworld > ROOM:
            raise SimulationError("out_of_memory: made up at once", Failure.OUT_OF_MEMORY)
        if self.behaviour == DOOMED_CROWD and not (logdir / "died_once").exists():
            (logdir / "died_once").touch()
            os.kill(os.getpid(), signal.SIGKILL)

    @property
    def _moved(self) -> Path:
        return self.logdir.parent.parent / "moved"

    @property
    def finished(self) -> bool:
        return self.epoch >= self.config.trial.epochs

    def score(self) -> float:
        """100 for a rate of 0.01, 50 for 0.001, 0 for 0.0001, approached over ten epochs."""
        height = 100 + 50 * math.log10(self.config.shac.actor_lr / 0.01)
        return height * (1 - math.exp(-self.epoch / 10))

    def run_epoch(self) -> dict[str, float]:
        time.sleep(self.seconds_per_epoch)
        hold, stop = Path(os.environ.get("STUB_HOLD", "/nowhere")), self.logdir.parent.parent / "stop"
        while self.epoch >= HELD_AT and hold.exists() and not stop.exists():
            time.sleep(0.01)
        while self.epoch == HELD_AT and self._arrived() < self.members and not stop.exists():
            time.sleep(0.01)
        if self.epoch == 0:
            (self.logdir / "checkpoints" / "best.pt").write_text("untrained")
            self._write({**self._row(), "eval/score": 0.0})
        ends = self.until_moved and self._moved.exists()
        self.epoch = self.config.trial.epochs if ends else self.epoch + 1
        row = self._row()
        if self.epoch == MISBEHAVE_AT:
            self._misbehave(row)
        if self.epoch % self.config.evaluation.interval == 0 or self.finished:
            score = self.score()
            row["eval/score"] = score
            if score > self.best_score:
                self.best_score = score
                (self.logdir / "checkpoints" / "best.pt").write_text(str(score))
            row["eval/best_score"] = self.best_score
        self._write(row)
        if self.epoch % self.config.execution.checkpoint_interval == 0 or self.finished:
            self.save()
        return row

    def _arrived(self) -> int:
        """Trials of this experiment that have done `HELD_AT` epochs (their first row is of epoch 0)."""
        rows = [file.read_bytes().count(b"\n") for file in self.logdir.parent.glob("*/metrics.jsonl")]
        return sum(count > HELD_AT for count in rows)

    def _row(self) -> dict[str, float]:
        steps = 100 * self.epoch
        return {"epoch": self.epoch, "env_steps": steps, "seconds": 0.02 * self.epoch, "env_steps_per_s": 5000.0}

    def _misbehave(self, row: dict[str, float]) -> None:
        marker = self.logdir / "died_once"
        if self.behaviour == KILL and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if self.behaviour == HANG and not marker.exists():
            marker.touch()
            time.sleep(1000)
        if self.behaviour == FULL_DISK and not marker.exists():
            marker.touch()
            raise OSError(errno.ENOSPC, "No space left on device")
        if self.behaviour == BROKEN_CONNECTION and not marker.exists():
            marker.touch()
            raise ConnectionResetError(errno.ECONNRESET, "made up")
        if self.behaviour in (EXIT, EXIT_ZERO):
            sys.exit(3 if self.behaviour == EXIT else 0)
        if self.behaviour == INTERRUPT:
            raise KeyboardInterrupt
        if self.behaviour == MEMORY or (self.behaviour == LATE_CROWD and self.config.env.nworld > ROOM):
            raise SimulationError("out_of_memory: made up", Failure.OUT_OF_MEMORY)
        if self.behaviour == NAN:
            row["train/actor_loss"] = math.nan
        if self.behaviour == SIMULATION_ERROR:
            raise SimulationError("nonfinite_gradient: made up", Failure.NONFINITE)
        if self.behaviour == BUG:
            raise RuntimeError("made up")

    def _write(self, row: dict[str, float]) -> None:
        bad = [key for key, value in row.items() if not math.isfinite(value)]
        clean = {key: None if key in bad else value for key, value in row.items()}
        with (self.logdir / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(clean | ({"nonfinite": bad} if bad else {})) + "\n")

    @property
    def _checkpoint(self) -> Path:
        return self.logdir / "checkpoints" / f"epoch_{self.epoch:06d}.pt"

    def discard_checkpoint(self) -> None:
        self._checkpoint.unlink(missing_ok=True)

    def save(self) -> Path:
        path = self._checkpoint
        state = {"epoch": self.epoch, "best_score": self.best_score, "nworld": self.config.env.nworld}
        path.write_text(json.dumps(state | {"trial": self.logdir.name}))
        return path

    def restore(self, path: Path, changed: Collection[str] = ()) -> None:
        state = json.loads(path.read_bytes())
        if state["nworld"] != self.config.env.nworld:
            raise CheckpointError(f"{path} was written under other settings")
        self.epoch, self.best_score = state["epoch"], state["best_score"]
        # `changed` does not say it: a member that is paused or retried gets its own state back in the same way.
        if self.until_moved and state["trial"] != self.logdir.name:
            self._moved.touch()

    def restore_latest(self) -> tuple[Path | None, list[str]]:
        checkpoints = sorted((self.logdir / "checkpoints").glob("epoch_*.pt"))
        if not checkpoints:
            return None, []
        self.restore(checkpoints[-1])
        return checkpoints[-1], []

    def close(self) -> None:
        pass
