"""Checks whether a trial repeats: trains it twice, in fresh processes, and compares every tensor bit by bit."""

import itertools
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from msk_ray.config import Config, dump_yaml, overlay, parse_config
from msk_ray.errors import MskRayError, SimulationError


@dataclass(frozen=True)
class Difference:
    """The first stage in which two runs differ."""

    epoch: int
    """Counted from 1; 0 is the start."""
    stage: str
    tensors: tuple[str, ...]
    """Tensors of that stage that differ."""

    def __str__(self) -> str:
        where = "before the first epoch" if self.epoch == 0 else f"in epoch {self.epoch}"
        return f"{where}, stage {self.stage}: {', '.join(self.tensors)}"


StageDigest = tuple[int, str, str, str]
"""Epoch, stage, tensor and digest."""


def first_difference(first: list[StageDigest], second: list[StageDigest]) -> Difference | None:
    """The first stage in which two runs differ; None if they are equal to the last bit."""
    for a, b in itertools.zip_longest(first, second):
        if a != b:
            epoch, stage = (a or b)[:2]
            ours, theirs = ({n: d for e, s, n, d in run if (e, s) == (epoch, stage)} for run in (first, second))
            names = [n for n in {**ours, **theirs} if ours.get(n) != theirs.get(n)]
            return Difference(epoch, stage, tuple(names))
    return None


def compare(config: Config, device: str, epochs: int) -> tuple[Difference | None, int]:
    """Train the first epochs of a trial twice, with different values of OMP_NUM_THREADS, which must not matter.

    Args:
        config: the trial.
        device: cpu or cuda:N.
        epochs: number of epochs.

    Returns:
        The first difference, and the number of tensors compared.

    Raises:
        SimulationError: the trial fails.
    """
    first, second = (run_once(config, device, epochs, threads) for threads in (1, 3))
    return first_difference(first, second), len(first)


def run_once(config: Config, device: str, epochs: int, threads: int) -> list[StageDigest]:
    """Digests of the first epochs of a trial, trained in a fresh process with OMP_NUM_THREADS set to `threads`.

    Raises:
        SimulationError: the trial fails.
    """
    changed = {
        "trial.epochs": max(epochs, config.trial.epochs),
        "execution.checkpoint_interval": epochs + 1,
        "execution.loggers": [],
    }
    whole = parse_config(overlay(config.as_dict(), changed), "a repeated trial")
    with tempfile.TemporaryDirectory(prefix="repeat_") as scratch:
        path, out = Path(scratch) / "config.yaml", Path(scratch) / "noted.json"
        path.write_text(dump_yaml(whole.as_dict()))
        command = [sys.executable, "-m", "msk_ray.repeat", str(path), device, str(epochs), str(out)]
        offered = os.environ | {"OMP_NUM_THREADS": str(threads)}
        done = subprocess.run(command, capture_output=True, text=True, env=offered)
        if done.returncode or not out.exists():
            last = (done.stderr.strip().splitlines() or ["without a word"])[-1]
            raise SimulationError(f"the trial failed: {last}")
        return [(int(e), str(s), str(n), str(d)) for e, s, n, d in json.loads(out.read_text())]


def _train(path: Path, device: str, epochs: int, out: Path) -> None:
    """Entry point of that process: train, and write the digests."""
    from msk_ray.algorithms.digest_log import DigestLog
    from msk_ray.config import load_config
    from msk_ray.training import Trainer

    digest_log = DigestLog()
    trainer = Trainer(load_config(path), out.parent / "trial", device)
    trainer.algorithm.digest_log = digest_log
    trainer.algorithm.note_state()
    for epoch in range(1, epochs + 1):
        digest_log.epoch = epoch
        trainer.run_epoch()
        trainer.algorithm.note_state()
    trainer.close()
    out.write_text(json.dumps(digest_log.digests))


if __name__ == "__main__":
    try:
        _train(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), Path(sys.argv[4]))
    except MskRayError as error:
        sys.exit(" ".join(str(error).split()))
