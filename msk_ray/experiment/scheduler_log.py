"""The evaluations that the early-stopping rule was told, in their original order.

The trials' own records contain neither the order between trials nor which of their last rows had reached the driver
when it died; and a rule that is told an evaluation twice judges it twice, the second time against more trials.
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
    """One evaluation as it reached the driver."""

    trial: str
    epoch: int
    env_steps: int
    seconds: float
    score: float
    ended: bool
    """Whether the trial had ended on its own."""
    attempt: int = 1
    """The attempt at the trial; results of earlier attempts no longer count."""

    def time(self, attribute: str) -> float:
        """Progress as `env_steps`, `epoch` or `seconds`."""
        return Evaluation(self.epoch, self.env_steps, self.seconds, self.score).time(attribute)


class SchedulerLog:
    """The entries of an experiment, one JSON object per line."""

    def __init__(self, path: Path, guard: Callable[[], None] = lambda: None) -> None:
        """
        Args:
            path: path of the file.
            guard: called before it is written; raises if another driver owns the experiment by now.
        """
        self._path = path
        self._guard = guard

    def read(self) -> tuple[list[LogEntry], tuple[Damage, ...]]:
        """All entries, and the lines that cannot be used; an incomplete last line, left by a crash, is removed.

        Raises:
            StorageFailure: the storage does not give it, or the torn line cannot be cut off.
        """
        data = read_bytes(self._path, LOG) or b""
        whole, newline, torn = data.rpartition(b"\n")
        if torn:
            write_bytes(self._path, whole + newline)
        return read_lines(self._path, _entry)

    def append(self, entry: LogEntry) -> None:
        """Add one entry; once this returns, the entry survives a crash.

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
        # It may be NaN, which is written as such and handled by the rule.
        float(data["score"]) if isinstance(data.get("score"), float) else number(data, "score"),
        field(data, "ended", bool),
        field(data, "attempt", int),
    )
