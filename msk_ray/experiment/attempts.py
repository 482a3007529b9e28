"""Which attempt at a trial its folder holds, and with what settings.

A trial that runs out of memory may be tried once more, with half its worlds. The decision comes first, as a file:
whoever goes on from the folder, after whatever death, finds it and halves no second time. Then what the first attempt
left is set aside: states of W worlds do not fit half of them, and rows of both attempts would be no one's curve.
Everything that depends on the attempt asks the `Attempt` of the folder.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from msk_ray.config import overlay, parse_config
from msk_ray.errors import ConfigError, StorageFailure
from msk_ray.experiment.damage import DamagedFile, field, read_object
from msk_ray.experiment.layout import ABANDONED, EVAL_FILE, HALVED_FILE, METRICS_FILE
from msk_ray.experiment.trial import Trial
from msk_ray.files import write_json, write_text

_WORLDS = "env.nworld"
_LEFT = ("checkpoints", EVAL_FILE)


@dataclass(frozen=True)
class Reduced:
    """That an attempt has half the worlds asked for, and why."""

    asked: int
    worlds: int
    """Worlds it has."""
    why: str
    """What the attempt with all of them ended by."""
    cleared: bool = False
    """Whether what that attempt left has been set aside."""


@dataclass(frozen=True)
class Attempt:
    """An attempt at a trial: the first, with what was asked for, or the second, with half its worlds."""

    reduced: Reduced | None = None

    @property
    def number(self) -> int:
        """From 1."""
        return 1 if self.reduced is None else 2

    def __str__(self) -> str:
        """What sets it apart from what was asked for; empty for the first."""
        return "" if self.reduced is None else f"half the worlds: {self.reduced.worlds} of {self.reduced.asked}"

    @property
    def suffix(self) -> str:
        """The same in brackets, to put behind a trial's name."""
        return f" ({self})" if self.reduced is not None else ""

    @property
    def mark(self) -> str:
        """The same in short, to put behind an outcome."""
        return ", half the worlds" if self.reduced is not None else ""

    def effective(self, trial: Trial) -> Trial:
        """A trial as this attempt runs it. It keeps its id, which stands for what was asked for.

        Raises:
            ConfigError: half the worlds do not go with its other settings.
        """
        if self.reduced is None:
            return trial
        worlds = self.reduced.worlds
        settings = overlay(trial.config.as_dict(), {_WORLDS: worlds})
        return replace(
            trial,
            config=parse_config(settings, f"trial {trial.id} with {worlds} worlds"),
            changed=trial.changed | {_WORLDS: str(worlds)},
            values=trial.values | {_WORLDS: worlds},
        )

    def next(self, trial: Trial, why: str) -> "Attempt":
        """The attempt that follows this one.

        Args:
            trial: as it was asked for.
            why: what this attempt ran out of memory at.

        Raises:
            ConfigError: there is none, saying why.
        """
        if self.reduced is not None:
            raise ConfigError(f"{self.reduced.asked} worlds were asked for, and half of them has been tried")
        asked = trial.config.env.nworld
        try:
            if asked < 2:
                raise ConfigError("a single world cannot be halved")
            following = Attempt(Reduced(asked, asked // 2, why))
            following.effective(trial)
        except ConfigError as fault:
            raise ConfigError(f"half of them could not be tried: {fault}") from None
        return following

    def begin(self, folder: Path) -> "Attempt":
        """Decide on this attempt and move what the one before has left out of the way; safe to be cut short anywhere,
        and to be repeated. The decision outlives this process when this returns.

        TensorBoard's events stay: an empty metrics file tells the trainer to have them purged.

        Raises:
            StorageFailure: the disk is full or gone.
        """
        if self.reduced is None or self.reduced.cleared:
            return self
        self.write(folder)
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
        cleared = Attempt(replace(self.reduced, cleared=True))
        cleared.write(folder)
        return cleared

    def write(self, folder: Path) -> None:
        """Keep which attempt it is in a trial's folder.

        Raises:
            StorageFailure: the disk is full or gone.
        """
        assert self.reduced is not None  # the first needs no file
        write_json(folder / HALVED_FILE, vars(self.reduced))


FIRST = Attempt()


def load_attempt(folder: Path) -> Attempt:
    """Which attempt a trial's folder holds.

    Raises:
        DamagedFile: its file cannot be used.
        StorageFailure: the storage does not give it.
    """
    return read_object(folder / HALVED_FILE, _attempt) or FIRST


def read_attempt(folder: Path) -> Attempt:
    """The same, for who only shows it: one whose file cannot be used counts as the first. `TrialSnapshot` names the
    damage, and the trial itself ends by it."""
    try:
        return load_attempt(folder)
    except DamagedFile:
        return FIRST


def _attempt(data: dict[str, Any]) -> Attempt:
    asked, worlds = field(data, "asked", int), field(data, "worlds", int)
    if not 1 <= worlds < asked:
        raise ValueError(f"{worlds} of {asked} worlds cannot be")
    return Attempt(Reduced(asked, worlds, field(data, "why", str), field(data, "cleared", bool)))
