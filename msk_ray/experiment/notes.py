"""Notes that people write about trials, stored in the experiment's folder."""

from pathlib import Path
from typing import Any

from msk_ray.errors import ConfigError
from msk_ray.experiment.damage import CATALOGUE, field, read_object, texts
from msk_ray.experiment.layout import NOTES_FILE
from msk_ray.files import write_json

LONGEST = 2000
"""Maximum length of a note, in characters."""


def load_notes(experiment: Path) -> dict[str, str]:
    """Note by trial id; empty if there are none.

    Raises:
        DamagedFile: the file cannot be used.
        StorageFailure: the storage does not give it.
    """
    return read_object(experiment / NOTES_FILE, _notes, CATALOGUE) or {}


def write_note(experiment: Path, trial: str, text: str) -> None:
    """Replace the note on a trial; an empty one removes it.

    Raises:
        ConfigError: the note is too long.
        DamagedFile: the file holds something else, which is not overwritten.
        StorageFailure: the disk is full or gone.
    """
    text = text.strip()
    if len(text) > LONGEST:
        raise ConfigError(f"a note has at most {LONGEST} characters, not {len(text)}")
    notes = load_notes(experiment)
    notes.pop(trial, None)
    if text:
        notes[trial] = text
    write_json(experiment / NOTES_FILE, {"trials": notes})


def _notes(data: dict[str, Any]) -> dict[str, str]:
    trials = field(data, "trials", dict)
    if not texts(trials.values()):
        raise ValueError("a note is no text")
    return dict(trials)
