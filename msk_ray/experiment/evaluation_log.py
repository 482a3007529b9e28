"""Log of the evaluations given to the early-stopping rule, in their order.

The trials' own records contain neither the order across trials nor which of their last rows had reached the driver when
it died. And a rule must not get an evaluation twice: it would compare it again, with more trials. What the rule decides
is in the outcome.json of each trial, written by `tune/supervisor.py`.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from msk_ray.experiment.damage import LOG, Damage, field, number, read_bytes, read_lines
from msk_ray.experiment.metrics import EPOCH_LIMIT, Evaluation
from msk_ray.files import append_text, write_bytes


@dataclass(frozen=True)
class LogEntry:
    """One evaluation as the driver received it."""

    trial: str
    epoch: int
    env_steps: int
    seconds: float
    score: float
    ended: bool
    """Whether the trial had ended on its own."""
    attempt: int = 1
    """Number of the attempt at the trial; results of earlier attempts are ignored."""

    def time(self, attribute: str) -> float:
        """Progress as `env_steps`, `epoch` or `seconds`."""
        return Evaluation(self.epoch, self.env_steps, self.seconds, self.score).time(attribute)


class EvaluationLog:
    """The log of an experiment, one JSON object per line."""

    def __init__(self, path: Path, guard: Callable[[], None] = lambda: None) -> None:
        """
        Args:
            path: path of the file.
            guard: called before each write; raises if another driver owns the experiment by now.
        """
        self._path = path
        self._guard = guard

    def read(self) -> tuple[list[LogEntry], tuple[Damage, ...]]:
        """All entries, and the unusable lines; an incomplete last line, left by a crash, is removed.

        Raises:
            StorageFailure: the storage cannot be read, or the incomplete line cannot be removed.
        """
        data = read_bytes(self._path, LOG) or b""
        whole, newline, torn = data.rpartition(b"\n")
        if torn:
            write_bytes(self._path, whole + newline)
        return read_lines(self._path, _entry)

    def append(self, entry: LogEntry) -> None:
        """Append an entry; once this returns, the entry survives a crash.

        Raises:
            StorageFailure: the disk is full or gone, or the guard raises it.
        """
        self._guard()
        append_text(self._path, json.dumps(asdict(entry)) + "\n")


def _entry(data: dict[str, Any]) -> LogEntry:
    epoch, env_steps = field(data, "epoch", int), field(data, "env_steps", int)
    if not 0 <= epoch < EPOCH_LIMIT:
        raise ValueError("an epoch that cannot be")
    if not 0 <= env_steps < 10**300:
        raise ValueError("env_steps that cannot be")
    return LogEntry(
        field(data, "trial", str),
        epoch,
        env_steps,
        number(data, "seconds"),
        # It may be NaN, which is written as NaN; the rule handles it.
        float(data["score"]) if isinstance(data.get("score"), float) else number(data, "score"),
        field(data, "ended", bool),
        field(data, "attempt", int),
    )
