"""The interface between the trainer and a logger."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar


class Logger(ABC):
    """Sends a trial's rows to a place where people read them. A subclass needs `write`.

    Rows are in `metrics.jsonl` before loggers get them, and every logger gets them even if another one fails. An
    exception ends the trial: as a storage failure if an OSError says that the disk is full or gone, otherwise as a
    failure of the logger.

    Attributes:
        folder: the trial's folder.
    """

    takes_late: ClassVar[bool] = False
    """Whether the logger has `write_late`. If one of a trial's loggers has not, each policy is scored before its row is
    written; on a GPU that is slower than scoring several together."""

    def __init__(self, folder: Path) -> None:
        """Open nothing here: a trial that cannot be resumed must leave its folder unchanged."""
        self.folder = folder

    @abstractmethod
    def write(self, row: dict[str, float]) -> None:
        """Log a row: `epoch`, `env_steps`, `seconds` and metrics such as `eval/score`, all of them finite."""

    def write_late(self, row: dict[str, float]) -> None:
        """Log figures that belong to an earlier row: its `epoch`, with `eval/score` and others."""
        raise NotImplementedError

    def config(self, settings: dict[str, Any]) -> None:  # noqa: B027  # optional
        """Log the trial's settings, nested as in config.yaml; called once before the first row."""

    def rewind(self, epoch: int) -> None:  # noqa: B027  # optional
        """Called before the first row of a trial resumed after `epoch`: rows of later epochs will be written again."""

    def close(self) -> None:  # noqa: B027  # optional
        """Write out everything that is still buffered."""
