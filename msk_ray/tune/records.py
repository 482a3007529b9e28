"""What a trial left on disk, read back: metrics, evaluations, outcome."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msk_ray.metrics_file import METRICS_FILE, read_metrics
from msk_ray.tune.experiment import Experiment
from msk_ray.tune.halved import Halved, read_halved
from msk_ray.tune.outcomes import Ending, Outcome, read_ending
from msk_ray.tune.stopping import Evaluation
from msk_ray.tune.trials import Trial


@dataclass(frozen=True)
class TrialRecord:
    """One trial as its folder shows it."""

    trial: Trial
    folder: Path
    epochs_done: int
    seconds: float
    """Training time [s]."""
    evaluations: tuple[Evaluation, ...]
    ending: Ending | None
    """None: not ended, whether running, waiting or interrupted."""
    halved: Halved | None = None
    """Set if it runs with half its worlds: then its scores do not compare with the others'."""

    @property
    def best(self) -> Evaluation | None:
        """The evaluation of the trained policy with the highest score; None if there was none with a score."""
        finite = [evaluation for evaluation in self.evaluations if math.isfinite(evaluation.score)]
        return max(finite, key=lambda evaluation: evaluation.score) if finite else None

    @property
    def best_checkpoint(self) -> Path | None:
        """Checkpoint of the best evaluation's policy; None if it is missing, or no trained policy has a score."""
        path = self.folder / "checkpoints" / "best.pt"
        return path if self.best is not None and path.is_file() else None

    @property
    def cut(self) -> bool:
        """Whether it stands before its end without having failed: given more, its score might have risen."""
        return self.ending.cut if self.ending is not None else bool(self.evaluations)

    @property
    def errored(self) -> bool:
        return self.ending is not None and self.ending.outcome in (Outcome.ERROR, Outcome.OUT_OF_MEMORY)


def read_record(trial: Trial, folder: Path) -> TrialRecord:
    """A trial's record; an empty one if it never started."""
    rows = read_rows(folder)
    last = rows[-1] if rows else {"epoch": 0, "seconds": 0.0}
    return TrialRecord(
        trial,
        folder,
        int(last["epoch"]),
        float(last["seconds"]),
        tuple(evaluations_of(rows)),
        read_ending(folder),
        read_halved(folder),
    )


def read_records(experiment: Experiment) -> list[TrialRecord]:
    """Records of all trials of an experiment, in order."""
    return [read_record(trial, experiment.trial_folder(trial.id)) for trial in experiment.trials()]


def read_rows(folder: Path) -> list[dict[str, float]]:
    """A trial's metrics, each epoch once. Values the file marks as not finite are NaN."""
    return [_with_nan(row) for row in read_metrics(folder / METRICS_FILE)]


def evaluations_of(rows: Sequence[Mapping[str, float]]) -> list[Evaluation]:
    """The evaluations of trained policies among rows of metrics."""
    found = (Evaluation.from_row(row) for row in rows)
    return [evaluation for evaluation in found if evaluation is not None]


def best_record(records: Sequence[TrialRecord]) -> TrialRecord | None:
    """The trial with the highest score at any evaluation; None if none has a score."""
    scored = [(record.best.score, -record.trial.index, record) for record in records if record.best is not None]
    return max(scored, key=lambda item: item[:2])[2] if scored else None


def _with_nan(row: Mapping[str, Any]) -> dict[str, float]:
    bad = row.get("nonfinite", [])
    return {key: math.nan if key in bad else value for key, value in row.items() if key != "nonfinite"}
