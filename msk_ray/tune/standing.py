"""Where an experiment stands, from its files alone: while it runs, after it died, or from another machine."""

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from msk_ray.config import current_key, parse_recorded, read_yaml
from msk_ray.errors import MskRayError
from msk_ray.metrics_file import METRICS_FILE
from msk_ray.tune.experiment import SPACE_FILE, Experiment
from msk_ray.tune.halved import Halved, read_halved
from msk_ray.tune.operators import describe
from msk_ray.tune.outcomes import read_ending
from msk_ray.tune.records import evaluations_of, read_rows
from msk_ray.tune.time_left import time_left
from msk_ray.tune.trials import Trial

DEVICE_FILE = "device.json"
OUTPUT_FILE = "output.log"
SUMMARY_FILE = "summary.json"
"""What a driver writes, with the table, when it ends by itself."""
_BEATS = (METRICS_FILE, DEVICE_FILE, OUTPUT_FILE)
"""Files that a trial's process writes to as long as it lives."""
RECENT = 10
"""Newest rows that speed is taken from."""
STALE_EPOCHS = 10
"""A trial is stale when it was silent for so many of its own epochs ..."""
STALE_S = 60.0
"""... and for at least so long [s]."""
STALE_STARTING_S = 600.0
"""The same for a process that has not done an epoch yet: it may be compiling."""


class State(StrEnum):
    """What a trial seems to be doing."""

    RUNNING = "running"
    STALE = "stale"
    """No sign of life for too long: its process, its machine or the whole experiment has died, or was stopped."""
    WAITING = "waiting"
    ENDED = "ended"
    UNREADABLE = "unreadable"
    """Its files make no sense."""


@dataclass(frozen=True)
class Progress:
    """What a trial's rows of metrics say."""

    epoch: int = 0
    best: float | None = None
    """Highest finite evaluation score of the trained policy."""
    env_steps_per_s: float | None = None
    """Median over the newest rows."""
    seconds_per_epoch: float | None = None
    """Mean over the newest rows [s]."""


@dataclass(frozen=True)
class Device:
    """What a trial's process was given."""

    host: str = ""
    gpu: str = "-"
    """Index on its host, or `cpu`."""
    name: str = ""


@dataclass(frozen=True)
class Standing:
    """One trial as its files show it at one moment."""

    id: str
    variant: str
    seed: int
    epochs: int
    """Planned."""
    state: State
    progress: Progress
    device: Device
    heartbeat_age: float | None
    """Time since its process last wrote something [s]; None if it never did."""
    outcome: str = ""
    """Name of its ending, if it has one."""
    note: str = ""
    """Why it ended, or what is wrong with its files."""
    halved: Halved | None = None
    """Set if it runs with half its worlds."""

    @property
    def seconds_left(self) -> float | None:
        """Until its last epoch at its present speed [s]; None unless it is running at a known speed."""
        speed = self.progress.seconds_per_epoch
        if self.state is not State.RUNNING or speed is None:
            return None
        return max(0, self.epochs - self.progress.epoch) * speed


class Observer:
    """Reads an experiment again and again; a file that has not changed is not read twice."""

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self._seen: dict[Path, tuple[tuple[int, int], Progress]] = {}
        self._trials: list[Trial] = []
        self._manifest: tuple[int, int] | None = None

    def look(self, now: float) -> list[Standing]:
        """All trials at `now` [s since the epoch], those at work first, then by score.

        Raises:
            StorageError: the folder holds no readable experiment.
        """
        found = [self._standing(trial, now) for trial in self._known()]
        found += self._unlisted({standing.id for standing in found}, now)
        return sorted(found, key=_order)

    def _known(self) -> list[Trial]:
        stamp = _stamp(self.experiment.path / "manifest.json")
        if stamp is None or stamp != self._manifest:
            self._trials, self._manifest = self.experiment.trials(), stamp
        return self._trials

    def _unlisted(self, listed: set[str], now: float) -> list[Standing]:
        """Trials a search has made up: the manifest learns of them only at the end."""
        folders = sorted(path for path in _subfolders(self.experiment.path / "trials") if path.name not in listed)
        if not folders:
            return []
        varied = read_yaml(self.experiment.path / SPACE_FILE).get("parameters") or {}
        return [self._made_up(folder, varied, now) for folder in folders]

    def _made_up(self, folder: Path, varied: Mapping[str, Any], now: float) -> Standing:
        path = folder / "config.yaml"
        try:
            config = parse_recorded(read_yaml(path), str(path))
        except MskRayError as error:
            return _unreadable(folder.name, "?", 0, 0, error)
        settings = config.as_dict()
        values = {key: _at(settings, key) for key in (current_key(key, config.env.name) for key in varied)}
        return self._standing(Trial(0, folder.name, {k: describe(v) for k, v in values.items()}, values, config), now)

    def _standing(self, trial: Trial, now: float) -> Standing:
        folder = self.experiment.trial_folder(trial.id)
        try:
            ending = read_ending(folder)
            progress = self._progress(folder)
            device = _device(folder / DEVICE_FILE)
            halved = read_halved(folder)
        except (MskRayError, OSError, ValueError, KeyError, TypeError) as error:
            # One trial's broken file must not hide the others; what is wrong with it is shown in its row.
            return _unreadable(trial.id, trial.variant, trial.seed, trial.epochs, error)
        age = heartbeat_age(folder, now)
        if ending is not None:
            state = State.ENDED
        elif age is None:
            state = State.WAITING
        else:
            state = State.STALE if is_silent(folder, progress, age) else State.RUNNING
        return Standing(
            trial.id,
            trial.variant,
            trial.seed,
            trial.epochs,
            state,
            progress,
            device,
            age,
            "" if ending is None else str(ending.outcome),
            "" if ending is None else ending.why,
            halved,
        )

    def _progress(self, folder: Path) -> Progress:
        path = folder / METRICS_FILE
        stamp = _stamp(path)
        if stamp is None:
            return Progress()
        cached = self._seen.get(path)
        if cached is None or cached[0] != stamp:
            cached = self._seen[path] = stamp, progress_of(read_rows(folder))
        return cached[1]


def progress_of(rows: Sequence[Mapping[str, float]]) -> Progress:
    """What rows of metrics, in order of epoch, say."""
    if not rows:
        return Progress()
    scores = [e.score for e in evaluations_of(rows) if math.isfinite(e.score)]
    recent = [row for row in rows[-RECENT - 1 :] if row["epoch"] > 0]
    speeds = [row["env_steps_per_s"] for row in recent if math.isfinite(row.get("env_steps_per_s", math.nan))]
    first, last = rows[-RECENT - 1 :][0], rows[-1]
    epochs = last["epoch"] - first["epoch"]
    return Progress(
        int(last["epoch"]),
        max(scores, default=None),
        statistics.median(speeds) if speeds else None,
        (last["seconds"] - first["seconds"]) / epochs if epochs else None,
    )


def heartbeat_age(folder: Path, now: float) -> float | None:
    """Seconds since a trial's process last wrote; None if it never did.

    Clocks of machines that share a storage differ: a heartbeat from the future is a fresh one.
    """
    beat = _last_beat(folder)
    return None if beat is None else max(0.0, now - beat)


def _last_beat(folder: Path) -> float | None:
    return max((beat for name in _BEATS if (beat := _modified(folder / name)) is not None), default=None)


def is_silent(folder: Path, progress: Progress, age: float) -> bool:
    """Whether a trial that has not ended shows no sign of life: it was silent for too long, or its driver, which writes
    the summary last of all, has left since."""
    summary, beat = _modified(folder.parent.parent / SUMMARY_FILE), _last_beat(folder)
    left = summary is not None and (beat is None or beat < summary)
    return left or age > patience(folder, progress)


def patience(folder: Path, progress: Progress) -> float:
    """How long a trial may be silent before it counts as stale [s]."""
    started, metrics = _modified(folder / DEVICE_FILE), _modified(folder / METRICS_FILE)
    # A process younger than the metrics, as after a retry, has not done an epoch of its own.
    starting = metrics is None or (started is not None and started >= metrics)
    if starting or progress.seconds_per_epoch is None:
        return STALE_STARTING_S
    return max(STALE_S, STALE_EPOCHS * progress.seconds_per_epoch)


def counts(standings: Sequence[Standing]) -> dict[State, int]:
    """How many trials are in each state; states that none is in are left out."""
    return {state: n for state in State if (n := sum(standing.state is state for standing in standings))}


def remaining(standings: Sequence[Standing]) -> float | None:
    """Seconds until the experiment is done, at most; None while none of its trials runs at a known speed."""
    running = [s for s in standings if s.state is State.RUNNING]
    idle = [s for s in standings if s.state in (State.WAITING, State.STALE)]
    return time_left(
        [(s.epochs - s.progress.epoch, s.progress.seconds_per_epoch) for s in running],
        [s.epochs - s.progress.epoch for s in idle],
        max(1, len(running)),
    )


def best_of(standings: Sequence[Standing]) -> Standing | None:
    """The trial with the highest score; None if none has one."""
    scored = [s for s in standings if s.progress.best is not None]
    return max(scored, key=lambda s: s.progress.best or -math.inf) if scored else None


def find_experiments(storage: Path) -> list[Path]:
    """Folders in a storage folder that are, or began to be, an experiment; the newest last."""
    found = [
        path
        for path in _subfolders(storage)
        if any((path / part).exists() for part in ("manifest.json", SPACE_FILE, "env.json"))
    ]
    return sorted(found, key=lambda path: (path.stat().st_mtime, path.name))


def _order(standing: Standing) -> tuple[int, float]:
    rank = [State.RUNNING, State.STALE, State.UNREADABLE, State.ENDED, State.WAITING].index(standing.state)
    return rank, -standing.progress.best if standing.progress.best is not None else math.inf


def _unreadable(trial_id: str, variant: str, seed: int, epochs: int, error: Exception) -> Standing:
    note = " ".join(f"{error if isinstance(error, MskRayError) else repr(error)}".split())
    return Standing(trial_id, variant, seed, epochs, State.UNREADABLE, Progress(), Device(), None, note=note)


def _device(path: Path) -> Device:
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return Device()
    if not facts["count"]:
        return Device(facts["host"], "cpu", "")
    # Without CUDA_VISIBLE_DEVICES a process sees all GPUs and takes the first.
    return Device(facts["host"], facts["visible"] or "0", facts["name"])


def _at(settings: Mapping[str, Any], dotted: str) -> Any:
    node: Any = settings
    for part in dotted.split("."):
        node = node[part]
    return node


def _stamp(path: Path) -> tuple[int, int] | None:
    """Modification time [ns] and size; None if there is no such file."""
    try:
        facts = path.stat()
    except FileNotFoundError:
        return None
    return facts.st_mtime_ns, facts.st_size


def _modified(path: Path) -> float | None:
    stamp = _stamp(path)
    return None if stamp is None else stamp[0] * 1e-9


def _subfolders(path: Path) -> list[Path]:
    return [child for child in path.iterdir() if child.is_dir()] if path.is_dir() else []
