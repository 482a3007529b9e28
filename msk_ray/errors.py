"""Errors that a user can fix. Each message is one line that says what to write or do instead."""

import errno
import reprlib
from enum import StrEnum

_STORAGE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.ESTALE}


def shortened(text: str, limit: int = 80) -> str:
    """A text cut to at most `limit` characters, ending in dots if something was left out."""
    return text if len(text) <= limit else f"{text[: limit - 3]}..."


_BRIEF = reprlib.Repr()
_BRIEF.maxstring = _BRIEF.maxother = _BRIEF.maxlong = 60


def brief(value: object) -> str:
    """The `repr` of a value for an error message, short however large the value is."""
    return shortened(_BRIEF.repr(value), 160)


class MskRayError(Exception):
    """Base of every error whose cause is outside the code; entry points print it as one line and exit with 2."""

    exit_code = 2


class ConfigError(MskRayError):
    """A configuration, search space or command line asks for something that does not exist or is not possible."""


class DeviceError(MskRayError):
    """The requested device is missing or too small."""


class CheckpointError(MskRayError):
    """A checkpoint is missing, incomplete, or belongs to another configuration."""


class ExportError(MskRayError):
    """An exported policy does not compute what its checkpoint does."""


class StorageError(MskRayError):
    """A folder cannot be written, or already holds something else."""


class StorageFailure(StorageError):
    """Writing failed while the work was running: the disk is full or gone. What was saved before is complete, and the
    work can be resumed from it."""

    exit_code = 75  # EX_TEMPFAIL


class LoggerError(MskRayError):
    """A logger raised an exception. What it was given is in the trial's own record."""


class OwnershipLost(StorageFailure):
    """Another process has become the owner of a folder that this one was writing to, or the folder has disappeared."""


class ClusterLost(MskRayError):
    """The Ray node that this process belongs to has died. Trials continue from their checkpoints in a new Ray."""

    exit_code = 75  # EX_TEMPFAIL


def storage_failure(error: BaseException) -> StorageFailure | None:
    """The storage failure that is, or has caused, an exception; None if it has another cause."""
    seen: BaseException | None = error
    while seen is not None:
        # Ray wraps an exception from another process in one of the same class, which carries it as `cause`.
        inner = getattr(seen, "cause", None)
        if isinstance(inner, BaseException):
            seen = inner
            continue
        if isinstance(seen, StorageFailure):
            return seen
        if isinstance(seen, OSError) and seen.errno in _STORAGE_ERRORS:
            return StorageFailure(f"cannot write {seen.filename or 'to the storage'}: {seen.strerror}")
        seen = seen.__cause__ or seen.__context__
    return None


class RankLost(MskRayError):
    """A process of a trial that has several died. The trial continues from its last checkpoint."""

    exit_code = 75  # EX_TEMPFAIL


class UnsupportedModelError(MskRayError):
    """A model feature cannot be differentiated by the chosen backward mode."""


class Failure(StrEnum):
    """How a simulation can fail; a trial's outcome has the same name."""

    DIVERGED = "diverged"
    """Worlds diverged, or contacts or constraint rows were lost."""
    NONFINITE = "nonfinite"
    """A gradient was NaN or infinite."""
    OUT_OF_MEMORY = "out_of_memory"
    """The device has less memory than the settings need."""


class SimulationError(MskRayError):
    """The physics could not be computed with these settings."""

    def __init__(self, message: str, failure: Failure = Failure.DIVERGED) -> None:
        super().__init__(message, failure)  # both, so that the error survives pickling between processes
        self.message = message
        self.failure = failure

    def __str__(self) -> str:
        return self.message
