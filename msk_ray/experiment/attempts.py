"""Which attempt at a trial its folder holds, and with what settings.

A trial that runs out of memory may be restarted once, with half its worlds. The decision is written to a file first, so
that any process that continues from the folder, even after a crash, finds it and does not halve again. Then the files
of the first attempt are set aside: states of W worlds do not fit half of them, and rows of two attempts do not form one
curve. Everything that depends on the attempt uses the `Attempt` of the folder.
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
    """Records that an attempt has half the worlds asked for, and why."""

    asked: int
    worlds: int
    """Number of worlds it has."""
    why: str
    """Why the attempt with all of them ended."""
    cleared: bool = False
    """Whether the files of that attempt have been set aside."""


@dataclass(frozen=True)
class Attempt:
    """An attempt at a trial: the first, with the original settings, or the second, with half its worlds."""

    reduced: Reduced | None = None

    @property
    def number(self) -> int:
        """From 1."""
        return 1 if self.reduced is None else 2

    def __str__(self) -> str:
        """How it differs from the original settings; empty for the first attempt."""
        return "" if self.reduced is None else f"half the worlds: {self.reduced.worlds} of {self.reduced.asked}"

    @property
    def suffix(self) -> str:
        """The same in brackets, to follow a trial's name."""
        return f" ({self})" if self.reduced is not None else ""

    @property
    def mark(self) -> str:
        """A short form, to follow an outcome."""
        return ", half the worlds" if self.reduced is not None else ""

    def effective(self, trial: Trial) -> Trial:
        """A trial with the settings of this attempt. It keeps its id, which stands for the original settings.

        Raises:
            ConfigError: half the worlds are not possible with its other settings.
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
            trial: with its original settings.
            why: where this attempt ran out of memory.

        Raises:
            ConfigError: there can be none; the message says why.
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
        """Decide on this attempt and set aside the files of the previous one. This may be interrupted anywhere and
        repeated; once it returns, the decision survives a crash.

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
                # Files that are there already were moved before an interruption; nothing was trained since.
                if (folder / name).exists() and not (aside / name).exists():
                    (folder / name).rename(aside / name)
        except OSError as error:
            raise StorageFailure(f"cannot write {aside}: {error.strerror or error}") from error
        write_text(metrics, "")
        cleared = Attempt(replace(self.reduced, cleared=True))
        cleared.write(folder)
        return cleared

    def write(self, folder: Path) -> None:
        """Record in a trial's folder which attempt it is.

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
    """The same, for display only: an attempt whose file cannot be used counts as the first. `TrialSnapshot` names the
    damage, and the trial itself ends with an error."""
    try:
        return load_attempt(folder)
    except DamagedFile:
        return FIRST


def _attempt(data: dict[str, Any]) -> Attempt:
    asked, worlds = field(data, "asked", int), field(data, "worlds", int)
    if not 1 <= worlds < asked:
        raise ValueError(f"{worlds} of {asked} worlds cannot be")
    return Attempt(Reduced(asked, worlds, field(data, "why", str), field(data, "cleared", bool)))
