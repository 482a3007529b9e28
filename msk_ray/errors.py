"""Errors a user can mend. Each message is one line that says what to write or do instead."""


class MskRayError(Exception):
    """Base of every error whose cause lies outside the code; entry points print it as one line and exit 2."""

    exit_code = 2


class ConfigError(MskRayError):
    """A configuration, search space or command line asks for something that does not exist or fit."""


class DeviceError(MskRayError):
    """The requested device is missing or too small."""


class CheckpointError(MskRayError):
    """A checkpoint is missing, torn, or belongs to another configuration."""


class StorageError(MskRayError):
    """A folder cannot be written, or already holds something else."""


class UnsupportedModelError(MskRayError):
    """A model feature cannot be differentiated by the chosen backward mode."""


class SimulationError(MskRayError):
    """The physics could not be computed as asked: buffers overflowed, or too many worlds diverged."""
