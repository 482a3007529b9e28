"""The interface between the trainer and a logger."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar


class Logger(ABC):
    """Passes a trial's rows on to a place where people look at them. A subclass needs `write`.

    A row is in `metrics.jsonl` before any logger gets it, and every logger gets it, even if another one fails. An
    exception ends the trial: as a full or lost disk if it comes from an OSError of that kind, otherwise as a failure of
    the logger.

    Attributes:
        folder: the trial's folder.
    """

    takes_late: ClassVar[bool] = False
    """Whether `write_late` is there. If a logger of a trial has none, each policy is scored before its row is written,
    which on a GPU takes longer than scoring several together."""

    def __init__(self, folder: Path) -> None:
        """Do not open anything yet: a trial that cannot be resumed leaves its folder unchanged."""
        self.folder = folder

    @abstractmethod
    def write(self, row: dict[str, float]) -> None:
        """Log a row: `epoch`, `env_steps`, `seconds` and metrics such as `eval/score`, all of them finite."""

    def write_late(self, row: dict[str, float]) -> None:
        """Log figures of an earlier row that are known only now: its `epoch`, and `eval/score` and others."""
        raise NotImplementedError

    def config(self, settings: dict[str, Any]) -> None:  # noqa: B027  # a logger may do without
        """Log the trial's settings, nested as in config.yaml; called once before the first row."""

    def rewind(self, epoch: int) -> None:  # noqa: B027  # a logger may do without
        """The trial continues after `epoch`: rows of later epochs come again. Called before the first row."""

    def close(self) -> None:  # noqa: B027  # a logger may do without
        """Write out everything that is still buffered."""
