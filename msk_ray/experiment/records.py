"""The trials of an experiment as their files describe them: while it runs, after it has died, or from elsewhere."""

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msk_ray.config import current_key, parse_recorded, value_at
from msk_ray.errors import MskRayError
from msk_ray.experiment.damage import Damage, cut, read_settings
from msk_ray.experiment.layout import (
    ATTEMPT_FILE,
    CONFIG_FILE,
    DEVICE_FILE,
    ENVIRONMENT_FILE,
    MANIFEST_FILE,
    METRICS_FILE,
    OUTCOME_FILE,
    OUTPUT_FILE,
    SPACE_FILE,
)
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.snapshot import State, TrialReader, TrialSnapshot, file_stamp, read_trial
from msk_ray.experiment.trial import Trial, by_environment
from msk_ray.text import describe

_READ = (METRICS_FILE, OUTCOME_FILE, ATTEMPT_FILE, DEVICE_FILE, OUTPUT_FILE)
"""A trial is read again when one of these files changes."""
_ORDER = [State.RUNNING, State.STALE, State.INTERRUPTED, State.ENDED, State.WAITING]


@dataclass(frozen=True)
class TrialRecord(TrialSnapshot):
    """A trial, and the content of its folder at one moment."""

    trial: Trial
    note: str = ""
    """What its owner has written about it."""

    @property
    def seconds_left(self) -> float | None:
        """Time to its last epoch at its current speed [s]; None unless it is running at a known speed."""
        speed = self.progress.seconds_per_epoch
        if self.state is not State.RUNNING or speed is None:
            return None
        return max(0, self.trial.epochs - self.epochs_done) * speed


class ExperimentReader:
    """Reads an experiment's trials repeatedly, and each time only what has changed."""

    def __init__(self, experiment: Experiment, keep_rows: bool = True) -> None:
        """
        Args:
            experiment: the experiment.
            keep_rows: whether records hold all rows of metrics, or only their summary.
        """
        self.experiment = experiment
        self._reader = TrialReader(keep_rows)
        self._planned: tuple[Any, list[Trial]] | None = None
        self._unlisted: tuple[Any, tuple[list[Trial], list[Damage]]] | None = None
        self._seen: dict[Path, tuple[Any, TrialRecord]] = {}

    def planned(self) -> list[Trial]:
        """The trials of the manifest.

        Raises:
            StorageError: the folder holds no readable experiment.
        """
        stamp = file_stamp(self.experiment.path / MANIFEST_FILE)
        if self._planned is None or stamp is None or self._planned[0] != stamp:
            self._planned = stamp, self.experiment.trials(shown=True)
        return self._planned[1]

    def look(
        self, now: float, planned: Sequence[Trial], notes: Mapping[str, str] | None = None
    ) -> tuple[list[TrialRecord], list[Damage]]:
        """Records of all trials at `now` [s since the epoch]; the same object for a trial that has not changed.

        Args:
            now: the time.
            planned: the trials of the manifest, as far as they are known.
            notes: what their owner has written about them, by id.

        Returns:
            Records of the planned trials, and of others that have a folder: those that a search has suggested, or all
            if the manifest is lost. And the files of folders that do not say what trial they are of.
        """
        unlisted, unreadable = self._others({trial.id for trial in planned})
        notes = notes or {}
        return [self._record(trial, notes.get(trial.id, ""), now) for trial in [*planned, *unlisted]], unreadable

    def _others(self, listed: set[str]) -> tuple[list[Trial], list[Damage]]:
        folders = [path for path in subfolders(self.experiment.path / "trials") if path.name not in listed]
        key = (len(listed), {path.name: file_stamp(path / CONFIG_FILE) for path in folders})
        if self._unlisted is None or self._unlisted[0] != key:
            self._unlisted = key, _unlisted_trials(self.experiment, sorted(folders), len(listed))
        return self._unlisted[1]

    def _record(self, trial: Trial, note: str, now: float) -> TrialRecord:
        folder = self.experiment.trial_folder(trial.id)
        # The planned trial is part of the key because `--extend` gives it more epochs.
        key = (trial, note, [file_stamp(folder / name) for name in _READ])
        seen = self._seen.get(folder)
        if seen is not None and seen[0] == key and seen[1].state is State.ENDED:
            return seen[1]
        record = TrialRecord(**vars(self._reader.read(folder, now)), trial=trial, note=note)
        # Whether an unfinished trial counts as running also depends on the time.
        if seen is not None and seen[0] == key and seen[1].state is record.state:
            return seen[1]
        self._seen[folder] = key, record
        return record


def read_record(trial: Trial, folder: Path) -> TrialRecord:
    """A trial's record; an empty one if it never started."""
    return TrialRecord(**vars(read_trial(folder)), trial=trial)


def read_records(experiment: Experiment) -> list[TrialRecord]:
    """Records of the trials in an experiment's manifest, in order."""
    reader, now = TrialReader(), time.time()
    trials = experiment.trials()
    return [TrialRecord(**vars(reader.read(experiment.trial_folder(t.id), now)), trial=t) for t in trials]


def records_by_environment(records: Sequence[TrialRecord]) -> dict[str, list[TrialRecord]]:
    """Records by environment; scores of different environments are not comparable."""
    return by_environment(records, lambda record: record.trial.environment)


def best_record(records: Sequence[TrialRecord]) -> TrialRecord | None:
    """The trial with the highest score at any evaluation; None if none has a score."""
    scored = [(record.score, -record.trial.index, record) for record in records if record.score is not None]
    return max(scored, key=lambda item: item[:2])[2] if scored else None


def best_records(records: Sequence[TrialRecord]) -> dict[str, TrialRecord]:
    """The best trial of each environment; environments without a score are left out."""
    bests = {name: best_record(group) for name, group in records_by_environment(records).items()}
    return {name: best for name, best in bests.items() if best is not None}


def in_order(records: Sequence[TrialRecord]) -> list[TrialRecord]:
    """Running trials first, then the others by state; those of a state by environment, the highest score first."""

    def rank(record: TrialRecord) -> tuple[int, str, bool, float]:
        return _ORDER.index(record.state), record.trial.environment, record.score is None, -(record.score or 0.0)

    return sorted(records, key=rank)


def count_states(records: Sequence[TrialRecord]) -> list[str]:
    """`3 running` and the like, for each state that trials have."""
    return [f"{n} {state}" for state in State if (n := sum(record.state is state for record in records))]


def describe_bests(records: Sequence[TrialRecord], *, ids: bool) -> str:
    """`12.3`, or `ant 12.3, hopper 4.5` if trials run in several environments; empty if none has a score.

    Args:
        ids: whether to name the trials, as in `12.3 (1a2b3c4d)`.
    """
    several = len({record.trial.environment for record in records}) > 1
    return ", ".join(
        f"{name + ' ' if several else ''}{best.score:.5g}{f' ({best.trial.id})' if ids else ''}"
        for name, best in sorted(best_records(records).items())
    )


def remaining(records: Sequence[TrialRecord]) -> float | None:
    """Upper bound on the seconds until the experiment is done; None while no running trial's speed is known."""
    running = [r for r in records if r.state is State.RUNNING]
    idle = [r for r in records if r.state in (State.WAITING, State.STALE, State.INTERRUPTED)]
    return eta(
        [(r.trial.epochs - r.epochs_done, r.progress.seconds_per_epoch) for r in running],
        [r.trial.epochs - r.epochs_done for r in idle],
        max(1, len(running)),
    )


def eta(running: list[tuple[int, float | None]], waiting: list[int], concurrent: int) -> float | None:
    """Seconds until all trials have run to their last epoch; an upper bound, because some are stopped earlier.

    Args:
        running: for each running trial its epochs left and its seconds per epoch, None while unknown.
        waiting: epochs of each trial not yet started.
        concurrent: number of trials that run at the same time.

    Returns:
        None while no speed is known.
    """
    known = [speed for _, speed in running if speed is not None]
    if not known:
        return None
    mean = sum(known) / len(known)
    # The longest first, each in the slot that becomes free first.
    slots = sorted(left * (speed if speed is not None else mean) for left, speed in running)
    slots = [0.0] * max(0, concurrent - len(slots)) + slots
    for epochs in sorted(waiting, reverse=True):
        slots[0] += epochs * mean
        slots.sort()
    return slots[-1]


def find_experiments(storage: Path) -> list[Path]:
    """Folders in a storage folder that are experiments, complete or not; the newest last."""
    folders = [
        path
        for path in subfolders(storage)
        if any((path / part).exists() for part in (MANIFEST_FILE, SPACE_FILE, ENVIRONMENT_FILE))
        and not (path / METRICS_FILE).exists()  # a single training run
    ]
    return sorted(folders, key=lambda path: (path.stat().st_mtime, path.name))


def subfolders(path: Path) -> list[Path]:
    """The folders in a folder; empty if it does not exist."""
    return [child for child in path.iterdir() if child.is_dir()] if path.is_dir() else []


def _unlisted_trials(experiment: Experiment, folders: Sequence[Path], first: int) -> tuple[list[Trial], list[Damage]]:
    """The trials of folders that are not in the manifest, from their `config.yaml`, and the unusable ones among these.

    Args:
        experiment: the experiment.
        folders: the folders.
        first: position of the first of the trials.
    """
    try:
        parameters = list(read_settings(experiment.path / SPACE_FILE).get("parameters") or {}) if folders else []
    except (MskRayError, TypeError):
        parameters = []  # their settings are known anyway; only the varied ones are not marked
    trials: list[Trial] = []
    damages = []
    for folder in folders:
        path = folder / CONFIG_FILE
        if not os.path.lexists(path):
            continue  # created, but nothing was written to it
        try:
            config = parse_recorded(read_settings(path), str(path), shown=True)
            settings = config.as_dict()
            values = {key: value_at(settings, key) for key in map(current_key, parameters)}
        except (MskRayError, KeyError, TypeError) as error:
            damages.append(Damage(path, cut(f"no settings of a trial: {error}")))
            continue
        changed = {key: describe(value) for key, value in values.items()}
        trials.append(Trial(first + len(trials), folder.name, changed, values, config))
    return trials, damages
