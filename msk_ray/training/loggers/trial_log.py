"""All of a trial's loggers as one."""

import math
from collections.abc import Callable
from pathlib import Path

from msk_ray.config import Config, logger_paths, resolve_class
from msk_ray.config.loggers import LOGGERS
from msk_ray.errors import LoggerError, StorageFailure, storage_failure
from msk_ray.experiment.damage import Damage
from msk_ray.training.loggers.base import Logger
from msk_ray.training.loggers.jsonl import JsonLines


class TrialLog:
    """Writes each row to `metrics.jsonl`, then passes it to every logger.

    Raises:
        ConfigError: a logger's name is unknown, or its package is not installed.
    """

    def __init__(self, folder: Path, config: Config) -> None:
        self._lines = JsonLines(folder)
        self._settings = config.as_dict()
        paths = logger_paths(config.execution.loggers)
        classes = [resolve_class(path, LOGGERS.key, Logger) for path in paths]  # type: ignore[type-abstract]
        self._loggers = {name: kind(folder) for name, kind in zip(config.execution.loggers, classes, strict=True)}
        self._told = False

    @property
    def takes_late(self) -> bool:
        """Whether figures can be added to rows already written."""
        return all(logger.takes_late for logger in self._loggers.values())

    def rewind(self, epoch: int) -> tuple[Damage, ...]:
        """Drop rows after `epoch`, which a resumed trial will write again, and damaged lines.

        Returns:
            The damaged lines of `metrics.jsonl`.

        Raises:
            StorageFailure: the rows cannot be read or written.
            LoggerError: as for `write`.
        """
        damages = self._lines.rewind(epoch)
        self._each(lambda logger: logger.rewind(epoch))
        return damages

    def write(self, row: dict[str, float]) -> None:
        """Append one row.

        Raises:
            StorageFailure: the disk is full or gone.
            LoggerError: a logger failed. The row is in `metrics.jsonl`, and the other loggers have it.
        """
        self._lines.write(row)
        self._tell()
        finite = _finite(row)
        self._each(lambda logger: logger.write(dict(finite)))

    def write_late(self, row: dict[str, float], late: dict[str, float]) -> None:
        """Add figures to an earlier row; in `metrics.jsonl` the completed row is appended and replaces the earlier one.

        Raises:
            StorageFailure, LoggerError: as for `write`.
        """
        self._lines.write(row | late)
        self._tell()
        finite = _finite({"epoch": row["epoch"], **late})
        self._each(lambda logger: logger.write_late(dict(finite)))

    def close(self) -> None:
        """Flush every logger.

        Raises:
            StorageFailure, LoggerError: as for `write`; the rows are in `metrics.jsonl` in any case.
        """
        self._each(lambda logger: logger.close())

    def _tell(self) -> None:
        if not self._told:
            self._told = True
            self._each(lambda logger: logger.config(self._settings))

    def _each(self, call: Callable[[Logger], None]) -> None:
        first: Exception | None = None
        for name, logger in self._loggers.items():
            try:
                call(logger)
            except Exception as error:  # any type: loggers call other libraries
                fault = _named(name, error)
                fault.__cause__ = error
                first = first or fault
        if first is not None:
            raise first


def _finite(row: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in row.items() if math.isfinite(value)}


def _named(name: str, error: Exception) -> Exception:
    stored = storage_failure(error)
    if stored is None and isinstance(error, OSError) and error.filename is not None:
        # e.g. the trial's folder has disappeared
        stored = StorageFailure(f"{error.filename}: {error.strerror or error}")
    if stored is not None:
        return StorageFailure(f"execution.loggers: {name} cannot write: {stored}")
    text = (str(error).splitlines() or [""])[0]
    return LoggerError(
        f"execution.loggers: {name} failed ({type(error).__name__}: {text}); the rows are in metrics.jsonl: leave it "
        "out, or fix it, to continue"
    )
