"""How a trial ended: a name and a reason, recorded in the trial's folder."""

from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from msk_ray.errors import shortened
from msk_ray.experiment.damage import DamagedFile, field, read_object
from msk_ray.experiment.layout import OUTCOME_FILE
from msk_ray.files import write_json

_LONGEST = 10_000
"""Maximum length of a reason, in characters."""


class Outcome(StrEnum):
    """How a trial can end."""

    FINISHED = "finished"
    """Ran to its last epoch."""
    STOPPED_ASHA = "stopped_asha"
    """Other trials were better at the same number of env steps."""
    STOPPED_MEDIAN = "stopped_median"
    """Its best score was below the median of the others' running means."""
    STOPPED_PLATEAU = "stopped_plateau"
    """Its best score no longer rose."""
    STOPPED_TARGET = "stopped_target"
    """It reached the target score."""
    STOPPED_RULE = "stopped_rule"
    """A rule written by the user stopped it."""
    WALL_TIME = "wall_time"
    """It used up its time."""
    NONFINITE = "nonfinite"
    """A score, loss or gradient was NaN or infinite."""
    DIVERGED = "diverged"
    """A step lost contacts or constraint rows. A world that diverges only ends its episode."""
    OUT_OF_MEMORY = "out_of_memory"
    """Its device has less memory than its settings need."""
    ERROR = "error"
    """An exception, or its process died too often."""


FAILURES = {Outcome.NONFINITE, Outcome.DIVERGED, Outcome.OUT_OF_MEMORY, Outcome.ERROR}


@dataclass(frozen=True)
class Ending:
    """A trial's outcome, and the reason as text."""

    outcome: Outcome
    why: str

    @property
    def failed(self) -> bool:
        return self.outcome in FAILURES

    @property
    def cut(self) -> bool:
        """Whether the trial was stopped before its last epoch without failing, so that its score might have risen."""
        return not self.failed and self.outcome not in (Outcome.FINISHED, Outcome.WALL_TIME)


def write_ending(folder: Path, ending: Ending) -> None:
    """Write `ending` to a trial's folder atomically; a reason that is too long is cut."""
    write_json(folder / OUTCOME_FILE, asdict(replace(ending, why=shortened(ending.why, _LONGEST))))


def load_ending(folder: Path) -> Ending | None:
    """The ending in a trial's folder; None while it has none.

    Raises:
        DamagedFile: its file cannot be used.
        StorageFailure: the storage does not give it.
    """
    return read_object(folder / OUTCOME_FILE, _ending)


def read_ending(folder: Path) -> Ending | None:
    """The same, for continuing trials: None if the file is damaged, so that the trial continues. `TrialSnapshot`
    reports the damage."""
    try:
        return load_ending(folder)
    except DamagedFile:
        return None


def _ending(data: dict[str, Any]) -> Ending:
    name = field(data, "outcome", str)
    if name not in list(Outcome):
        raise ValueError(f"outcome {name!r:.40} is none that this version knows")
    return Ending(Outcome(name), field(data, "why", str))
