"""Reading a trial's `metrics.jsonl`. Writing is elsewhere, so that readers need not load torch."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msk_ray.experiment.damage import Damage, DamagedFile, field, is_number, number, read_lines, texts
from msk_ray.experiment.layout import METRICS_FILE
from msk_ray.metrics import SCORE

HASH = "hash/parameters"
"""The first 48 bits of the hash of the trial's weights and statistics at the evaluation, as a whole number."""
EPOCH_LIMIT = 10**9
"""Upper bound on the number of epochs."""
RECENT = 10
"""Number of newest rows used to compute the speed."""


@dataclass(frozen=True)
class Evaluation:
    """One deterministic evaluation of a trial's policy after at least one epoch.

    The score before training appears in curves only, because it is not a result of the trial.
    """

    epoch: int
    env_steps: int
    seconds: float
    score: float

    @classmethod
    def from_row(cls, row: Mapping[str, float]) -> "Evaluation | None":
        """The evaluation in a row of metrics; None if the epoch had none, or the policy was not trained yet."""
        if SCORE not in row or row["epoch"] <= 0:
            return None
        return cls(int(row["epoch"]), int(row["env_steps"]), float(row["seconds"]), float(row[SCORE]))

    def time(self, attribute: str) -> float:
        """Progress as `env_steps`, `epoch` or `seconds`."""
        return float({"env_steps": self.env_steps, "epoch": self.epoch, "seconds": self.seconds}[attribute])


@dataclass(frozen=True)
class Metrics:
    """A trial's metrics."""

    rows: tuple[dict[str, Any], ...] = ()
    """The latest row of each epoch, in order of epoch. As in the file, non-finite values are None, and named in the
    row's `nonfinite`."""
    damages: tuple[Damage, ...] = ()


def load_metrics(path: Path) -> Metrics:
    """A trial's metrics without damaged lines; empty if there is no file.

    Raises:
        DamagedFile: it is no regular file, or too large.
        StorageFailure: the storage does not give it.
    """
    try:
        lines, damages = read_lines(path, _row)
    except DamagedFile as error:
        raise DamagedFile(error.damage, "remove it, and the trial continues without its earlier rows") from None
    rows = {row["epoch"]: row for row in lines}
    return Metrics(tuple(rows[epoch] for epoch in sorted(rows)), damages)


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The rows of `load_metrics`."""
    return list(load_metrics(path).rows)


def _row(row: dict[str, Any]) -> dict[str, Any]:
    """A checked row.

    Raises:
        ValueError: it is not a row of a trial.
    """
    epoch = field(row, "epoch", int)
    if not 0 <= epoch < EPOCH_LIMIT:
        raise ValueError(f"epoch {epoch:.3g} cannot be" if abs(epoch) < 10**300 else "an epoch that cannot be")
    for name, value in row.items() if "nonfinite" in row or not _all_finite(row) else ():
        if name == "nonfinite":
            if not isinstance(value, list) or not texts(value):
                raise ValueError("nonfinite is no list of names")
        elif value is not None and not is_number(value):  # None stands for a value that was not finite
            raise ValueError(f"{name:.40} is no finite number")
    if SCORE in row:
        number(row, "env_steps")
        number(row, "seconds")
    return row


def _all_finite(row: Mapping[str, Any]) -> bool:
    """A fast check that all values are finite numbers, as in most rows. It may return False although they are."""
    try:
        return set(map(type, row.values())) <= {int, float} and math.isfinite(sum(row.values()))
    except OverflowError:
        return False


def with_nan(row: Mapping[str, Any]) -> dict[str, float]:
    """A row of metrics whose missing values are NaN."""
    if "nonfinite" not in row and None not in row.values():
        return dict(row)
    return {key: math.nan if value is None else value for key, value in row.items() if key != "nonfinite"}


def read_rows(folder: Path) -> list[dict[str, float]]:
    """A trial's metrics, each epoch once. Values that were not finite are NaN.

    Raises:
        StorageFailure: the storage cannot be read.
    """
    return [with_nan(row) for row in load_metrics(folder / METRICS_FILE).rows]


def evaluations_of(rows: Sequence[Mapping[str, float]]) -> list[Evaluation]:
    """The evaluations of trained policies among rows of metrics."""
    evaluations = (Evaluation.from_row(row) for row in rows)
    return [evaluation for evaluation in evaluations if evaluation is not None]


def last_figures(rows: Sequence[Mapping[str, float]], names: Sequence[str]) -> tuple[float, ...] | None:
    """These metrics at the last evaluation of a trained policy; None if one is missing or not finite."""
    evaluated = [row for row in rows if Evaluation.from_row(row) is not None]
    values = tuple(evaluated[-1].get(name, math.nan) for name in names) if evaluated else (math.nan,)
    return values if all(map(math.isfinite, values)) else None


@dataclass(frozen=True)
class TrialProgress:
    """A summary of a trial's rows of metrics."""

    epoch: int = 0
    best: float | None = None
    """Highest finite evaluation score of the trained policy."""
    env_steps_per_s: float | None = None
    """Median over the newest rows."""
    seconds_per_epoch: float | None = None
    """Mean over the newest rows [s]; None after only one epoch, whose time includes compilation."""


def progress_of(rows: Sequence[Mapping[str, float]]) -> TrialProgress:
    """A summary of rows of metrics, which are in order of epoch."""
    if not rows:
        return TrialProgress()
    scores = [e.score for e in evaluations_of(rows) if math.isfinite(e.score)]
    recent = [row for row in rows[-RECENT - 1 :] if row["epoch"] > 0]
    speeds = [row["env_steps_per_s"] for row in recent if math.isfinite(row.get("env_steps_per_s", math.nan))]
    first, last = next(iter(recent), rows[-1]), rows[-1]
    epochs = last["epoch"] - first["epoch"]
    seconds = last.get("seconds", math.nan) - first.get("seconds", math.nan)
    return TrialProgress(
        int(last["epoch"]),
        max(scores, default=None),
        statistics.median(speeds) if speeds else None,
        seconds / epochs if epochs and math.isfinite(seconds) else None,
    )
