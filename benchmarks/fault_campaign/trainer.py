"""A trainer whose process can be shot at from the inside, and the driver of a sweep of such trials."""

import errno
import functools
import json
import math
import os
import resource
import signal
import sys
import time
from pathlib import Path
from typing import Any

import torch

from msk_ray.training import Trainer
from msk_ray.tune import driver, session


class FaultyTrainer(Trainer):
    """A trainer that does to its own process what it finds in `EXPERIMENT/faults/TRIAL/EPOCH`, once each."""

    def _take(self) -> str | None:
        path = self.logdir.parent.parent / "faults" / self.logdir.name / str(self.epoch + 1)
        if not path.is_file():
            return None
        kind = path.read_text()
        path.rename(path.with_suffix(".done"))
        return kind

    def run_epoch(self) -> dict[str, float]:
        kind = self._take()
        match kind:
            case "kill":
                _kill_self()
            case "hang":
                time.sleep(3600)
            case "memory":
                self._crowd()
            case "nan":
                next(self.algorithm.network.parameters()).data.fill_(math.nan)
            case "infinite":
                run = self.evaluator.run
                self.evaluator.run = lambda policies: [f | {"score": math.inf} for f in run(policies)]  # type: ignore[method-assign]
            case "exit 3":
                sys.exit(3)
            case "exit 0":
                sys.exit(0)
            case "interrupt":
                raise KeyboardInterrupt
            case "bug":
                raise ValueError("made up")
            case "broken connection":
                raise ConnectionResetError(errno.ECONNRESET, "made up")
        row = super().run_epoch()
        match kind:
            case "torn_row":
                with (self.logdir / "metrics.jsonl").open("a") as file:
                    file.write(json.dumps({"epoch": self.epoch + 1, "env_steps": 1})[:17])
                _kill_self()
            case "torn_checkpoint":
                # What lies there after a death on a disk that lost half of it.
                path = self.save()
                os.truncate(path, path.stat().st_size // 2)
                _kill_self()
        return row

    def _crowd(self) -> None:
        """Let this process have hardly more memory than it has, and its next update ask for much more."""
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + 2**28
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        update = self.algorithm.update

        def crowded(epoch: int) -> Any:
            torch.empty(2**30)
            return update(epoch)

        self.algorithm.update = crowded  # type: ignore[method-assign]


def _kill_self() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def drive(arguments: list[str]) -> int:
    """`python -m msk_ray.tune` with trials that can be shot at, and without the dashboard's share of the cores."""
    from ray import cloudpickle

    from msk_ray.cli import run
    from msk_ray.tune.__main__ import main as tune_main

    # Trials' processes need not find this module.
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    driver.Plan = functools.partial(driver.Plan, make_trainer=FaultyTrainer)  # type: ignore[assignment,misc]
    session.ray_session = functools.partial(session.ray_session, dashboard=False)
    return run(tune_main, arguments)
