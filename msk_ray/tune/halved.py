"""A trial that ran out of memory and starts anew with half its worlds: what its folder keeps of that, and the words.

The decision comes first, as a file; whoever goes on from the folder, and after whatever death, finds it and halves no
second time. Then what was done with all the worlds is set aside: states of W worlds do not fit half of them, and rows
of both attempts would be no one's curve.
"""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from msk_ray.config import overlay, parse_config
from msk_ray.errors import ConfigError, StorageFailure
from msk_ray.files import write_json, write_text
from msk_ray.metrics_file import METRICS_FILE
from msk_ray.tune.trials import Trial

HALVED_FILE = "halved.json"
ABANDONED = "abandoned"
"""Folder, in the trial's own, of what was done with all its worlds."""
_WORLDS = "env.nworld"
_LEFT = ("checkpoints", "eval.json")


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

    def of(self, trial: Trial) -> Trial:
        """The trial as it runs. It keeps its id, which stands for what was asked for.

        Raises:
            ConfigError: half the worlds do not go with its other settings.
        """
        settings = overlay(trial.config.as_dict(), {_WORLDS: self.worlds})
        return replace(
            trial,
            config=parse_config(settings, f"trial {trial.id} with {self.worlds} worlds"),
            changed=trial.changed | {_WORLDS: str(self.worlds)},
            values=trial.values | {_WORLDS: self.worlds},
        )


class StartAnew(Exception):
    """The trial goes on with half its worlds, in a process that the failed attempt has left no memory in."""

    def __init__(self, halved: Halved) -> None:
        super().__init__(halved)
        self.halved = halved

    def __str__(self) -> str:
        return f"out of memory with {self.halved.asked} worlds: starting anew with half of them, {self.halved.worlds}"


def halve(trial: Trial, why: str) -> Halved:
    """Half of a trial's worlds, rounded down.

    Args:
        trial: as it was asked for.
        why: what it ran out of memory at.

    Raises:
        ConfigError: it has a single world, or half of them do not go with its other settings.
    """
    asked = trial.config.env.nworld
    if asked < 2:
        raise ConfigError("a single world cannot be halved")
    halved = Halved(asked, asked // 2, why)
    halved.of(trial)
    return halved


def read_halved(folder: Path) -> Halved | None:
    """What a trial's folder says of its worlds; None if it has all it was to have."""
    path = folder / HALVED_FILE
    return Halved(**json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else None


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
