"""Errors of the differentiable step that a user can fix. Each message is one line that says what to write instead."""

import reprlib
from enum import StrEnum


def shortened(text: str, limit: int = 80) -> str:
    """A text cut to at most `limit` characters, ending in dots if it was cut."""
    return text if len(text) <= limit else f"{text[: limit - 3]}..."


_BRIEF = reprlib.Repr()
_BRIEF.maxstring = _BRIEF.maxother = _BRIEF.maxlong = 60


def brief(value: object) -> str:
    """The `repr` of a value for an error message, cut if it is long."""
    return shortened(_BRIEF.repr(value), 160)


class MskRayError(Exception):
    """Base class of errors whose cause is outside the code; entry points print them as one line and exit with 2."""

    exit_code = 2


class ConfigError(MskRayError):
    """A configuration, search space or command line asks for something unknown or impossible."""


class DeviceError(MskRayError):
    """The requested device is missing or too small."""


class UnsupportedModelError(MskRayError):
    """The chosen backward mode cannot differentiate a feature of the model."""


class Failure(StrEnum):
    """How a simulation can fail; a trial's outcome gets the same name."""

    DIVERGED = "diverged"
    """In training, a step lost contacts or constraint rows; elsewhere, any other failure."""
    NONFINITE = "nonfinite"
    """A gradient was NaN or infinite."""
    OUT_OF_MEMORY = "out_of_memory"
    """The device has less memory than the settings need."""


class SimulationError(MskRayError):
    """The physics could not be computed with these settings."""

    def __init__(self, message: str, failure: Failure = Failure.DIVERGED) -> None:
        super().__init__(message, failure)  # both arguments, so that the error survives pickling between processes
        self.message = message
        self.failure = failure

    def __str__(self) -> str:
        return self.message
