"""That a trial runs with half its worlds, as its folder keeps it.

The decision comes first, as a file; whoever goes on from the folder, and after whatever death, finds it and halves no
second time. Then what was done with all the worlds is set aside: states of W worlds do not fit half of them, and rows
of both attempts would be no one's curve.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from msk_ray.errors import StorageFailure
from msk_ray.experiment.damage import field, read_object
from msk_ray.experiment.layout import ABANDONED, EVAL_FILE, HALVED_FILE, METRICS_FILE
from msk_ray.files import write_json, write_text

_LEFT = ("checkpoints", EVAL_FILE)


@dataclass(frozen=True)
class Halved:
    """That a trial runs with half its worlds, and why."""

    asked: int
    """Worlds it was to have."""
    worlds: int
    """Worlds it has."""
    why: str
    """What the attempt with all of them ended by."""
    cleared: bool = False
    """Whether what that attempt left has been set aside."""

    def __str__(self) -> str:
        return f"half the worlds: {self.worlds} of {self.asked}"


def read_halved(folder: Path) -> Halved | None:
    """What a trial's folder says of its worlds; None if it has all it was to have.

    Raises:
        DamagedFile: its file cannot be used.
        StorageFailure: the storage does not give it.
    """
    return read_object(folder / HALVED_FILE, _halved)


def _halved(data: dict[str, Any]) -> Halved:
    asked, worlds = field(data, "asked", int), field(data, "worlds", int)
    if not 1 <= worlds < asked:
        raise ValueError(f"{worlds} of {asked} worlds cannot be")
    return Halved(asked, worlds, field(data, "why", str), field(data, "cleared", bool))


def write_halved(folder: Path, halved: Halved) -> None:
    """Keep the decision; it outlives this process when this returns.

    Raises:
        StorageFailure: the disk is full or gone.
    """
    write_json(folder / HALVED_FILE, asdict(halved))


def set_aside(folder: Path, halved: Halved) -> Halved:
    """Move what was done with all the worlds out of the way, if that has not been done; safe to be cut short anywhere.

    TensorBoard's events stay: an empty metrics file tells the trainer to have them purged.

    Raises:
        StorageFailure: the disk is full or gone.
    """
    if halved.cleared:
        return halved
    metrics, aside = folder / METRICS_FILE, folder / ABANDONED
    try:
        aside.mkdir(exist_ok=True)
        for name in (*_LEFT, METRICS_FILE):
            # What is there already was moved before this was cut short; nothing was trained since.
            if (folder / name).exists() and not (aside / name).exists():
                (folder / name).rename(aside / name)
    except OSError as error:
        raise StorageFailure(f"cannot write {aside}: {error.strerror or error}") from error
    write_text(metrics, "")
    cleared = replace(halved, cleared=True)
    write_halved(folder, cleared)
    return cleared
