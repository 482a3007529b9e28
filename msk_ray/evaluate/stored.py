"""A trial's `eval.json`: its evaluations, read and written without torch."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msk_ray.evaluate.targets import trial_folder_of
from msk_ray.experiment.damage import CATALOGUE, DamagedFile, field, is_number, number, read_object
from msk_ray.experiment.layout import EVAL_FILE
from msk_ray.files import write_json

FORMAT = 1


def eval_file_of(checkpoint: Path) -> Path:
    """Where evaluations of a checkpoint are stored: in its trial's folder."""
    return trial_folder_of(checkpoint) / EVAL_FILE


def read_evaluations(path: Path) -> list[dict[str, Any]]:
    """The entries of an `eval.json`; an empty list if the file does not exist.

    Raises:
        StorageError: the file holds something else.
    """
    try:
        return read_object(path, _evaluations, CATALOGUE) or []
    except DamagedFile as error:
        raise DamagedFile(error.damage, "remove it to have it written again") from None


def _evaluations(data: dict[str, Any]) -> list[dict[str, Any]]:
    if data.get("format") != FORMAT:
        raise ValueError(f"it holds no evaluations of format {FORMAT}")
    entries: list[dict[str, Any]] = field(data, "evaluations", list)
    for place, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise ValueError(f"evaluation {place} is no object")
        try:
            _check_evaluation(entry)
        except ValueError as error:
            raise ValueError(f"evaluation {place}: {error}") from None
    return entries


def _check_evaluation(entry: dict[str, Any]) -> None:
    for name in ("checkpoint", "physics", "sha256", "device"):
        field(entry, name, str)
    for name in ("worlds", "steps", "epoch"):
        field(entry, name, int)
    field(entry, "canonical", bool)
    for name in ("fall_rate", "diverged_rate", *(["success_rate"] if "success_rate" in entry else [])):
        number(entry, name)
    if not all(map(is_number, field(entry, "seeds", list))):
        raise ValueError("seeds are no numbers")
    groups = [
        {name: entry.get(name) for name in ("score", "length")},
        *(field(entry, n, dict) for n in ("outcomes", "terms")),
    ]
    for group in groups:
        for name in group:
            spread_of = field(group, name, dict)
            for part in ("mean", "std", "min", "max"):
                number(spread_of, part)


def store_evaluation(path: Path, entry: Mapping[str, Any]) -> None:
    """Add an entry to an `eval.json`; it replaces the one with the same checkpoint, physics, worlds, seeds and steps.

    Raises:
        StorageError: the file exists and holds something else, or cannot be written.
    """
    key = ("checkpoint", "physics", "worlds", "seeds", "steps")
    kept = [old for old in read_evaluations(path) if any(old.get(k) != entry[k] for k in key)]
    write_json(path, {"format": FORMAT, "evaluations": [*kept, dict(entry)]})
