"""The attempts at a trial: which one its folder holds, and with what settings.

A trial that runs out of memory may be restarted once, with half its worlds. First the decision is written to a file, so
that a process that continues from the folder, even after a crash, does not halve again. Then the files of the first
attempt are moved aside: a state of W worlds does not fit W/2, and rows of two attempts do not form one curve. Code that
depends on the attempt uses the `Attempt` of the folder.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from msk_ray.config import overlay, parse_config
from msk_ray.errors import ConfigError, StorageFailure
from msk_ray.experiment.damage import DamagedFile, field, read_object
from msk_ray.experiment.layout import ABANDONED, ATTEMPT_FILE, EVAL_FILE, METRICS_FILE
from msk_ray.experiment.trial import Trial
from msk_ray.files import write_json, write_text

_WORLDS = "env.nworld"
_LEFT = ("checkpoints", EVAL_FILE)


@dataclass(frozen=True)
class WorldReduction:
    """Records that an attempt has half the worlds asked for, and why."""

    asked: int
    worlds: int
    """Number of worlds of this attempt."""
    why: str
    """Why the attempt with all worlds ended."""
    cleared: bool = False
    """Whether the files of the first attempt have been moved aside."""


@dataclass(frozen=True)
class Attempt:
    """An attempt at a trial: the first, with the original settings, or the second, with half its worlds."""

    reduction: WorldReduction | None = None

    @property
    def number(self) -> int:
        """1 or 2."""
        return 1 if self.reduction is None else 2

    def __str__(self) -> str:
        """How it differs from the original settings; empty for the first attempt."""
        return "" if self.reduction is None else f"half the worlds: {self.reduction.worlds} of {self.reduction.asked}"

    @property
    def suffix(self) -> str:
        """The same in parentheses, to append to a trial's name."""
        return f" ({self})" if self.reduction is not None else ""

    @property
    def mark(self) -> str:
        """A short form, to append to an outcome."""
        return ", half the worlds" if self.reduction is not None else ""

    def effective(self, trial: Trial) -> Trial:
        """The trial with the settings of this attempt. It keeps its id, which is the hash of the original settings.

        Raises:
            ConfigError: half the worlds are not possible with its other settings.
        """
        if self.reduction is None:
            return trial
        worlds = self.reduction.worlds
        settings = overlay(trial.config.as_dict(), {_WORLDS: worlds})
        return replace(
            trial,
            config=parse_config(settings, f"trial {trial.id} with {worlds} worlds"),
            changed=trial.changed | {_WORLDS: str(worlds)},
            values=trial.values | {_WORLDS: worlds},
        )

    def next(self, trial: Trial, why: str) -> "Attempt":
        """The next attempt.

        Args:
            trial: the trial with its original settings.
            why: where this attempt ran out of memory.

        Raises:
            ConfigError: no further attempt is possible; the message says why.
        """
        if self.reduction is not None:
            raise ConfigError(f"{self.reduction.asked} worlds were asked for, and half of them has been tried")
        asked = trial.config.env.nworld
        try:
            if asked < 2:
                raise ConfigError("a single world cannot be halved")
            following = Attempt(WorldReduction(asked, asked // 2, why))
            following.effective(trial)
        except ConfigError as fault:
            raise ConfigError(f"half of them could not be tried: {fault}") from None
        return following

    def begin(self, folder: Path) -> "Attempt":
        """Record this attempt, and move the files of the previous one aside. It can be interrupted anywhere and
        repeated; once it returns, the decision survives a crash.

        TensorBoard's event files stay: an empty metrics file makes the trainer purge them.

        Raises:
            StorageFailure: the disk is full or gone.
        """
        if self.reduction is None or self.reduction.cleared:
            return self
        self.write(folder)
        metrics, aside = folder / METRICS_FILE, folder / ABANDONED
        try:
            aside.mkdir(exist_ok=True)
            for name in (*_LEFT, METRICS_FILE):
                # Files already there were moved before an interruption; nothing has been trained since.
                if (folder / name).exists() and not (aside / name).exists():
                    (folder / name).rename(aside / name)
        except OSError as error:
            raise StorageFailure(f"cannot write {aside}: {error.strerror or error}") from error
        write_text(metrics, "")
        cleared = Attempt(replace(self.reduction, cleared=True))
        cleared.write(folder)
        return cleared

    def write(self, folder: Path) -> None:
        """Record in a trial's folder which attempt it is.

        Raises:
            StorageFailure: the disk is full or gone.
        """
        assert self.reduction is not None  # the first needs no file
        write_json(folder / ATTEMPT_FILE, vars(self.reduction))


FIRST = Attempt()


def load_attempt(folder: Path) -> Attempt:
    """Which attempt a trial's folder holds.

    Raises:
        DamagedFile: its file cannot be used.
        StorageFailure: the storage cannot be read.
    """
    return read_object(folder / ATTEMPT_FILE, _attempt) or FIRST


def read_attempt(folder: Path) -> Attempt:
    """The same, for display: if the file is damaged, the first attempt is assumed. `TrialSnapshot` reports the damage,
    and the trial itself ends with an error."""
    try:
        return load_attempt(folder)
    except DamagedFile:
        return FIRST


def _attempt(data: dict[str, Any]) -> Attempt:
    asked, worlds = field(data, "asked", int), field(data, "worlds", int)
    if not 1 <= worlds < asked:
        raise ValueError(f"{worlds} of {asked} worlds cannot be")
    return Attempt(WorldReduction(asked, worlds, field(data, "why", str), field(data, "cleared", bool)))
