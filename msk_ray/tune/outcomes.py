"""How a trial ended: a name, and why, kept in the trial's own folder."""

import json
import os
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from msk_ray.errors import StorageFailure

OUTCOME_FILE = "outcome.json"


class Outcome(StrEnum):
    """Names of the ways a trial can end."""

    FINISHED = "finished"
    """Ran to its last epoch."""
    STOPPED_ASHA = "stopped_asha"
    """Others did better at the same number of env steps."""
    STOPPED_MEDIAN = "stopped_median"
    """Its best score lay below the median of the others' running means."""
    STOPPED_PLATEAU = "stopped_plateau"
    """Its best score no longer rose."""
    STOPPED_TARGET = "stopped_target"
    """It reached the score asked for."""
    WALL_TIME = "wall_time"
    """It used up its time."""
    NONFINITE = "nonfinite"
    """A score, loss or gradient was NaN or infinite."""
    DIVERGED = "diverged"
    """Too many simulated worlds diverged."""
    OUT_OF_MEMORY = "out_of_memory"
    """Its device has less memory than its settings need."""
    ERROR = "error"
    """An exception, or its process died too often."""


@dataclass(frozen=True)
class Ending:
    """A trial's outcome and the reason in words."""

    outcome: Outcome
    why: str


def write_ending(folder: Path, ending: Ending) -> None:
    """Put `ending` into a trial's folder, whole or not at all."""
    write_json(folder / OUTCOME_FILE, asdict(ending))


def read_ending(folder: Path) -> Ending | None:
    """The ending in a trial's folder; None while it has none."""
    path = folder / OUTCOME_FILE
    if not path.is_file():
        return None
    data = json.loads(path.read_text(encoding="utf-8"))
    return Ending(Outcome(data["outcome"]), data["why"])


def write_json(path: Path, data: Any) -> None:
    """Write plain data so that a reader never sees half a file, and the file survives a crash right after."""
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write text so that a reader never sees half a file, and the file survives a crash right after.

    Raises:
        StorageFailure: the disk is full or the folder not writable; what was there before is untouched.
    """
    # Another process may write the same file: each has its own temporary.
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise StorageFailure(f"cannot write {path}: {error.strerror or error}") from error
