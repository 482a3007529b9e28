"""Progress of an experiment, read from its files: while it runs, after it has died, or from another machine."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from msk_ray.errors import MskRayError
from msk_ray.experiment.attempts import FIRST, Attempt
from msk_ray.experiment.damage import Damage, describe_damages, read_settings
from msk_ray.experiment.eta import eta
from msk_ray.experiment.layout import ENVIRONMENT_FILE, MANIFEST_FILE, METRICS_FILE, SPACE_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import TrialProgress
from msk_ray.experiment.results import unlisted_trials
from msk_ray.experiment.snapshot import Device, State, TrialReader, file_stamp
from msk_ray.experiment.trial import Trial, by_environment

_ORDER = [State.RUNNING, State.STALE, State.INTERRUPTED, State.UNREADABLE, State.ENDED, State.WAITING]


@dataclass(frozen=True)
class TrialStatus:
    """The state of one trial at one moment, according to its files."""

    id: str
    variant: str
    seed: int
    environment: str
    """Name of its environment; empty if unknown."""
    epochs: int
    """Planned epochs."""
    state: State
    progress: TrialProgress
    device: Device
    heartbeat_age: float | None
    """Time since its process last wrote a file [s]; None if it never did."""
    outcome: str = ""
    """Name of its outcome, if it has ended."""
    note: str = ""
    """Why it ended, what it is doing before its first epoch has ended, or what is wrong with its files."""
    attempt: Attempt = FIRST
    damages: tuple[Damage, ...] = ()
    """What was skipped in its files."""

    @property
    def seconds_left(self) -> float | None:
        """Time to its last epoch at its current speed [s]; None unless it is running at a known speed."""
        speed = self.progress.seconds_per_epoch
        if self.state is not State.RUNNING or speed is None:
            return None
        return max(0, self.epochs - self.progress.epoch) * speed


FIRST_EPOCH = "compiles kernels that are not in Warp's cache, records and trains its first epoch"
"""What a running trial does before its first epoch has ended."""


class StatusReader:
    """Reads an experiment repeatedly; unchanged files are not read again."""

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self._reader = TrialReader(keep_rows=False)
        self._trials: list[Trial] = []
        self._manifest: tuple[int, int] | None = None

    def look(self, now: float) -> list[TrialStatus]:
        """All trials at `now` [s since the epoch]: running ones first, then by environment and score.

        Raises:
            StorageError: the folder holds no readable experiment.
        """
        statuses = [self._status(trial, now) for trial in self._known()]
        statuses += self._unlisted({status.id for status in statuses}, now)
        return sorted(statuses, key=_order)

    def _known(self) -> list[Trial]:
        stamp = file_stamp(self.experiment.path / MANIFEST_FILE)
        if stamp is None or stamp != self._manifest:
            self._trials, self._manifest = self.experiment.trials(shown=True), stamp
        return self._trials

    def _unlisted(self, listed: set[str], now: float) -> list[TrialStatus]:
        """Trials suggested by a search, which are in the manifest only at the end."""
        if all(path.name in listed for path in _subfolders(self.experiment.path / "trials")):
            return []
        try:
            varied = list(read_settings(self.experiment.path / SPACE_FILE).get("parameters") or {})
        except (MskRayError, TypeError):
            varied = []  # their settings are known anyway; only the varied ones are not marked
        trials, damages = unlisted_trials(self.experiment, listed, varied)
        return [self._status(trial, now) for trial in trials] + [self._unreadable(damage) for damage in damages]

    def _unreadable(self, damage: Damage) -> TrialStatus:
        (note,) = describe_damages([damage], damage.path.parent)
        name = damage.path.parent.name
        return TrialStatus(
            name, "?", 0, "", 0, State.UNREADABLE, TrialProgress(), Device(), None, note=note, damages=(damage,)
        )

    def _status(self, trial: Trial, now: float) -> TrialStatus:
        seen = self._reader.read(self.experiment.trial_folder(trial.id), now)
        why = [] if seen.ending is None else [seen.ending.why]
        if seen.state is State.RUNNING and seen.progress.epoch == 0:
            why = [FIRST_EPOCH]
        return TrialStatus(
            trial.id,
            trial.variant,
            trial.seed,
            trial.environment,
            trial.epochs,
            seen.state,
            seen.progress,
            seen.device,
            seen.age,
            "" if seen.ending is None else str(seen.ending.outcome),
            "; ".join([*why, *describe_damages(seen.damages, seen.folder)]),
            seen.attempt,
            seen.damages,
        )


def counts(statuses: Sequence[TrialStatus]) -> dict[State, int]:
    """Number of trials in each state; states without trials are omitted."""
    return {state: n for state in State if (n := sum(status.state is state for status in statuses))}


def remaining(statuses: Sequence[TrialStatus]) -> float | None:
    """Upper bound on the seconds until the experiment is done; None while no running trial's speed is known."""
    running = [s for s in statuses if s.state is State.RUNNING]
    idle = [s for s in statuses if s.state in (State.WAITING, State.STALE, State.INTERRUPTED)]
    return eta(
        [(s.epochs - s.progress.epoch, s.progress.seconds_per_epoch) for s in running],
        [s.epochs - s.progress.epoch for s in idle],
        max(1, len(running)),
    )


def bests_of(statuses: Sequence[TrialStatus]) -> dict[str, TrialStatus]:
    """The trial with the highest score by environment, in order of their names. Environments without a score are
    omitted."""
    groups = by_environment(statuses, lambda status: status.environment)
    scored = {
        name: [(s.progress.best, s) for s in groups[name] if s.progress.best is not None] for name in sorted(groups)
    }
    return {name: max(group, key=lambda item: item[0])[1] for name, group in scored.items() if group}


def describe_bests(statuses: Sequence[TrialStatus], *, ids: bool) -> str:
    """`12.3`, or `ant 12.3, hopper 4.5` if trials run in several environments; empty if none has a score.

    Args:
        ids: whether to name the trials, as in `12.3 (1a2b3c4d)`.
    """
    several = len({status.environment for status in statuses if status.environment}) > 1
    texts = []
    for name, best in bests_of(statuses).items():
        which = f" ({best.id})" if ids else ""
        texts.append(f"{name + ' ' if several else ''}{best.progress.best:.5g}{which}")
    return ", ".join(texts)


def find_experiments(storage: Path) -> list[Path]:
    """Folders in a storage folder that are experiments, complete or not; the newest last."""
    folders = [
        path
        for path in _subfolders(storage)
        if any((path / part).exists() for part in (MANIFEST_FILE, SPACE_FILE, ENVIRONMENT_FILE))
        and not (path / METRICS_FILE).exists()  # a single training run
    ]
    return sorted(folders, key=lambda path: (path.stat().st_mtime, path.name))


def _order(status: TrialStatus) -> tuple[int, str, float]:
    rank = _ORDER.index(status.state)
    return rank, status.environment, -status.progress.best if status.progress.best is not None else math.inf


def _subfolders(path: Path) -> list[Path]:
    return [child for child in path.iterdir() if child.is_dir()] if path.is_dir() else []
