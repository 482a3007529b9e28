"""What the trainer asks of a logger."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any


class Logger(ABC):
    """Passes a trial's rows on to wherever people look at them. A class of its own needs `write`.

    A row is in `metrics.jsonl` before any logger gets it, and every logger gets it, even if another one failed. An
    exception ends the trial: as a full or lost disk if it comes from an OSError of that kind, else as a fault of the
    logger.

    Attributes:
        folder: the trial's.
    """

    def __init__(self, folder: Path) -> None:
        """Open nothing yet: a trial that cannot be resumed leaves its folder as it was."""
        self.folder = folder

    @abstractmethod
    def write(self, row: dict[str, float]) -> None:
        """Take in a row: `epoch`, `env_steps`, `seconds` and figures such as `eval/score`, all of them finite."""

    def config(self, settings: dict[str, Any]) -> None:  # noqa: B027  # a logger may do without
        """Take in the trial's settings, nested as in config.yaml; called once before the first row."""

    def rewind(self, epoch: int) -> None:  # noqa: B027  # a logger may do without
        """The trial goes on after `epoch`: rows of later epochs come again. Called before the first row."""

    def close(self) -> None:  # noqa: B027  # a logger may do without
        """Write out what is still on its way."""
