"""Errors that a user can fix. Each message is one line that says what to write or do instead."""

import errno

from msk_ray.step.errors import ConfigError as ConfigError
from msk_ray.step.errors import DeviceError as DeviceError
from msk_ray.step.errors import Failure as Failure
from msk_ray.step.errors import MskRayError as MskRayError
from msk_ray.step.errors import SimulationError as SimulationError
from msk_ray.step.errors import UnsupportedModelError as UnsupportedModelError
from msk_ray.step.errors import brief as brief
from msk_ray.step.errors import shortened as shortened

_STORAGE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.ESTALE}


class CheckpointError(MskRayError):
    """A checkpoint is missing, damaged, or of another configuration."""


class ExportError(MskRayError):
    """An exported policy computes something else than its checkpoint."""


class StorageError(MskRayError):
    """A folder cannot be written, or already holds something else."""


class StorageFailure(StorageError):
    """Writing failed during the work: the disk is full or gone. Everything saved before is complete, and the work can
    be resumed from it."""

    exit_code = 75  # EX_TEMPFAIL


class LoggerError(MskRayError):
    """A logger raised an exception. Its rows are in the trial's own `metrics.jsonl`."""


class OwnershipLost(StorageFailure):
    """Another process has taken over a folder that this one was writing to, or the folder has disappeared."""


class ClusterLost(MskRayError):
    """This process's Ray node has died. Trials can continue from their checkpoints in a new session."""

    exit_code = 75  # EX_TEMPFAIL


def storage_failure(error: BaseException) -> StorageFailure | None:
    """The storage failure that an exception is or was caused by; None if it has another cause."""
    seen: BaseException | None = error
    while seen is not None:
        # Ray wraps an exception from another process in one of the same class, with attribute `cause`.
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
    """One of a trial's several processes died. The trial can continue from its last checkpoint."""

    exit_code = 75  # EX_TEMPFAIL
