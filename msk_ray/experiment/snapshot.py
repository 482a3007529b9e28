"""Reading a trial's folder: the content of its files at one moment, in any condition."""

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from msk_ray.errors import StorageFailure
from msk_ray.experiment.attempts import FIRST, Attempt, load_attempt
from msk_ray.experiment.damage import Damage, DamagedFile, cut, describe_damages, field, read_object
from msk_ray.experiment.layout import (
    DEVICE_FILE,
    ERROR_FILE,
    METRICS_FILE,
    OUTPUT_FILE,
    SUMMARY_FILE,
    best_checkpoint_in,
)
from msk_ray.experiment.metrics import (
    Evaluation,
    Metrics,
    TrialProgress,
    evaluations_of,
    load_metrics,
    progress_of,
    with_nan,
)
from msk_ray.experiment.outcomes import Ending, Outcome, load_ending
from msk_ray.experiment.ownership import has_living_owner
from msk_ray.files import UnusableFile, last_lines
from msk_ray.metrics import SCORE

T = TypeVar("T")
_BEATS = (METRICS_FILE, DEVICE_FILE, OUTPUT_FILE)
"""Files that a living trial's process writes to."""
SILENT_EPOCHS = 10
"""A trial is silent when it has written nothing for this many of its own epochs ..."""
SILENT_S = 60.0
"""... and for at least this long [s]."""
SILENT_STARTING_S = 600.0
"""The same before the first epoch has ended, because the process may be compiling [s]."""
_TAIL_LINES = 12


class State(StrEnum):
    """What a trial seems to be doing."""

    RUNNING = "running"
    STALE = "stale"
    """Silent for too long although the experiment's driver is alive: it hangs, or its machine has died."""
    INTERRUPTED = "interrupted"
    """Started but not ended, and the experiment has no driver: it was stopped or died, and can be resumed."""
    WAITING = "waiting"
    """Not started, or not yet since its sweep was resumed."""
    ENDED = "ended"


@dataclass(frozen=True)
class Device:
    """The device of a trial's process."""

    host: str = ""
    gpu: str = "-"
    """Index of the GPU on its host, or `cpu`."""
    name: str = ""
    """Model of the GPU, or `cpu`; empty if it is not known."""


@dataclass(frozen=True)
class TrialSnapshot:
    """The content of a trial's folder at one moment."""

    folder: Path
    rows: tuple[dict[str, float], ...]
    """Metrics in order of epoch, each epoch once; NaN for values that are not finite. Empty if not requested."""
    progress: TrialProgress
    ending: Ending | None
    """None: not ended, whether running, waiting or interrupted."""
    attempt: Attempt
    """The scores of one with fewer worlds do not compare with the others'."""
    device: Device
    state: State
    beat: float | None
    """When its process last wrote a file [s since the epoch]; None if it never did."""
    damages: tuple[Damage, ...]
    """What was skipped."""

    @cached_property
    def evaluations(self) -> tuple[Evaluation, ...]:
        """Those of the trained policy."""
        return tuple(evaluations_of(self.rows))

    @cached_property
    def scored(self) -> tuple[dict[str, float], ...]:
        """The rows with a finite score, that of the untrained policy too."""
        return tuple(row for row in self.rows if math.isfinite(row.get(SCORE, math.nan)))

    @property
    def epochs_done(self) -> int:
        return self.progress.epoch

    @property
    def seconds(self) -> float:
        """Training time [s]."""
        seconds = self.rows[-1].get("seconds", math.nan) if self.rows else 0.0
        return seconds if math.isfinite(seconds) else 0.0

    @property
    def score(self) -> float | None:
        """Highest finite evaluation score of the trained policy; None before the first."""
        return self.progress.best

    @property
    def best(self) -> Evaluation | None:
        """The evaluation with the highest score."""
        finite = [evaluation for evaluation in self.evaluations if math.isfinite(evaluation.score)]
        return max(finite, key=lambda evaluation: evaluation.score, default=None)

    @property
    def best_row(self) -> dict[str, float]:
        """Its epoch, env steps, seconds, and every finite `eval/` metric."""
        row = max((row for row in self.scored if row["epoch"] > 0), key=lambda row: row[SCORE], default={})
        kept = ("epoch", "env_steps", "seconds")
        return {k: v for k, v in row.items() if (k.startswith("eval/") or k in kept) and math.isfinite(v)}

    def within(self, env_steps: float) -> list[Evaluation]:
        """The evaluations with a finite score in the first `env_steps`."""
        return [e for e in self.evaluations if e.env_steps <= env_steps and math.isfinite(e.score)]

    @property
    def best_checkpoint(self) -> Path | None:
        """Checkpoint of the best evaluation's policy, or of the untrained one before; None if it is missing."""
        path = best_checkpoint_in(self.folder)
        return path if path.is_file() else None

    @property
    def cut(self) -> bool:
        """Whether it neither reached its end nor failed: stopped, interrupted or running. Its score might have risen
        further."""
        if self.ending is not None:
            return self.ending.cut
        return self.state is not State.WAITING or self.epochs_done > 0

    @property
    def failed(self) -> bool:
        return self.ending is not None and self.ending.failed

    @property
    def errored(self) -> bool:
        return self.ending is not None and self.ending.outcome in (Outcome.ERROR, Outcome.OUT_OF_MEMORY)

    @property
    def outcome(self) -> str:
        """How it ended, or what it is doing."""
        return str(self.state if self.ending is None else self.ending.outcome)

    @property
    def why(self) -> str:
        """Why it ended, that it has fewer worlds, and what is wrong with its files."""
        ending = [] if self.ending is None else [self.ending.why]
        return "; ".join(filter(None, [str(self.attempt), *ending, *describe_damages(self.damages, self.folder)]))

    def tail(self) -> str:
        """The last lines of its error, or otherwise of its output."""
        for name in (ERROR_FILE, OUTPUT_FILE):
            with contextlib.suppress(FileNotFoundError):
                try:
                    return "\n".join(last_lines(self.folder / name, _TAIL_LINES))
                except UnusableFile as error:
                    return f"({name}: {error})"
        return ""


class TrialReader:
    """Reads trials' folders repeatedly; unchanged metrics files are not read again."""

    def __init__(self, keep_rows: bool = True) -> None:
        """
        Args:
            keep_rows: whether snapshots hold all rows of metrics, or only their summary.
        """
        self._keep_rows = keep_rows
        self._driver: tuple[Path, float, bool | None] = (Path(), math.nan, None)
        """(experiment, time, whether its driver was alive then; None without a lock): looked up once for all trials."""
        self._seen: dict[Path, tuple[tuple[int, int], tuple[tuple[dict[str, float], ...], TrialProgress, Metrics]]] = {}

    def read(self, folder: Path, now: float) -> TrialSnapshot:
        """A trial's folder at `now` [s since the epoch]; never fails, whatever the folder contains."""
        damages: list[Damage] = []
        rows, progress, metrics = self._metrics(folder / METRICS_FILE, damages)
        damages += metrics.damages
        ending = _try(lambda: load_ending(folder), None, folder, damages)
        attempt = _try(lambda: load_attempt(folder), FIRST, folder, damages)
        device = _try(lambda: read_object(folder / DEVICE_FILE, _device), None, folder, damages) or Device()
        beat = _last_beat(folder)
        if ending is not None:
            state = State.ENDED
        elif beat is None:
            state = State.WAITING
        else:
            state = self._state(folder, progress, beat, now)
        return TrialSnapshot(folder, rows, progress, ending, attempt, device, state, beat, tuple(damages))

    def _state(self, folder: Path, progress: TrialProgress, beat: float, now: float) -> State:
        """The state of a trial that has started and not ended."""
        experiment = folder.parent.parent
        if self._driver[:2] != (experiment, now):
            self._driver = experiment, now, has_living_owner(experiment, now)
        driven, summary = self._driver[2], _modified(experiment / SUMMARY_FILE)
        if summary is not None and beat < summary:
            # The driver writes the summary at its very end: a newer driver has not restarted this trial yet.
            return State.WAITING if driven else State.INTERRUPTED
        if driven is False:
            return State.INTERRUPTED
        # The clocks of machines that share a storage differ: a time in the future counts as now.
        if now - beat <= _patience(folder, progress):
            return State.RUNNING
        return State.INTERRUPTED if driven is None else State.STALE

    def _metrics(
        self, path: Path, damages: list[Damage]
    ) -> tuple[tuple[dict[str, float], ...], TrialProgress, Metrics]:
        stamp = file_stamp(path)
        if stamp is None:
            return (), TrialProgress(), Metrics()
        seen = self._seen.get(path)
        if seen is not None and seen[0] == stamp:
            return seen[1]
        metrics = _try(lambda: load_metrics(path), Metrics(), path, damages)
        rows = tuple(with_nan(row) for row in metrics.rows)
        reading = rows if self._keep_rows else (), progress_of(rows), Metrics((), metrics.damages)
        if not damages:
            self._seen[path] = stamp, reading
        return reading


def read_trial(folder: Path) -> TrialSnapshot:
    """A trial's folder now."""
    return TrialReader().read(folder, time.time())


def _try(read: Callable[[], T], otherwise: T, path: Path, damages: list[Damage]) -> T:
    try:
        return read()
    except DamagedFile as error:
        damages.append(error.damage)
    except StorageFailure as error:
        damages.append(Damage(path, cut(error)))
    return otherwise


def _device(facts: dict[str, Any]) -> Device:
    host = field(facts, "host", str)
    if not field(facts, "count", int):
        return Device(host, "cpu", "cpu")
    # Without CUDA_VISIBLE_DEVICES a process sees all GPUs and takes the first.
    return Device(host, field(facts, "visible", str) or "0", field(facts, "name", str))


def _last_beat(folder: Path) -> float | None:
    return max((beat for name in _BEATS if (beat := _modified(folder / name)) is not None), default=None)


def _patience(folder: Path, progress: TrialProgress) -> float:
    """How long a trial may write nothing before it counts as silent [s]."""
    started, metrics = _modified(folder / DEVICE_FILE), _modified(folder / METRICS_FILE)
    # After a retry, the process is younger than the metrics, and has not completed an epoch yet.
    starting = metrics is None or (started is not None and started >= metrics)
    if starting or progress.seconds_per_epoch is None:
        return SILENT_STARTING_S
    return max(SILENT_S, SILENT_EPOCHS * progress.seconds_per_epoch)


def file_stamp(path: Path) -> tuple[int, int] | None:
    """Modification time [ns] and size; None if there is no such file."""
    try:
        facts = path.stat()
    except OSError:
        return None
    return facts.st_mtime_ns, facts.st_size


def _modified(path: Path) -> float | None:
    stamp = file_stamp(path)
    return None if stamp is None else stamp[0] * 1e-9
