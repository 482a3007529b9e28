"""Results of an experiment's trials, read from their folders, for tables and for resuming."""

import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msk_ray.config import current_key, parse_recorded
from msk_ray.errors import MskRayError
from msk_ray.experiment.attempts import Attempt
from msk_ray.experiment.damage import Damage, cut, read_settings
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import Evaluation
from msk_ray.experiment.outcomes import Ending
from msk_ray.experiment.snapshot import TrialReader, TrialSnapshot, read_trial
from msk_ray.experiment.trial import Trial, by_environment
from msk_ray.text import describe


@dataclass(frozen=True)
class TrialRecord:
    """One trial and the content of its folder."""

    trial: Trial
    snapshot: TrialSnapshot

    @property
    def folder(self) -> Path:
        return self.snapshot.folder

    @property
    def epochs_done(self) -> int:
        return self.snapshot.epochs_done

    @property
    def seconds(self) -> float:
        """Training time [s]."""
        return self.snapshot.seconds

    @property
    def evaluations(self) -> tuple[Evaluation, ...]:
        return self.snapshot.evaluations

    @property
    def ending(self) -> Ending | None:
        """None while it has not ended: running, waiting or interrupted."""
        return self.snapshot.ending

    @property
    def attempt(self) -> Attempt:
        """Scores of an attempt with half the worlds are not comparable with the others."""
        return self.snapshot.attempt

    @property
    def best(self) -> Evaluation | None:
        """The trained policy's evaluation with the highest score; None if no evaluation has a score."""
        finite = [evaluation for evaluation in self.evaluations if math.isfinite(evaluation.score)]
        return max(finite, key=lambda evaluation: evaluation.score) if finite else None

    @property
    def best_checkpoint(self) -> Path | None:
        """Checkpoint of the best evaluation's policy; None if it is missing, or no trained policy has a score."""
        return self.snapshot.best_checkpoint if self.best is not None else None

    @property
    def cut(self) -> bool:
        """Whether it neither reached its end nor failed, so that its score might have risen further."""
        return self.ending.cut if self.ending is not None else bool(self.evaluations)

    @property
    def errored(self) -> bool:
        return self.snapshot.errored


def read_record(trial: Trial, folder: Path) -> TrialRecord:
    """A trial's record; an empty one if it never started."""
    return TrialRecord(trial, read_trial(folder, time.time()))


def read_records(experiment: Experiment) -> list[TrialRecord]:
    """Records of all trials of an experiment, in order."""
    reader, now = TrialReader(), time.time()
    return [TrialRecord(trial, reader.read(experiment.trial_folder(trial.id), now)) for trial in experiment.trials()]


def records_by_environment(records: Sequence[TrialRecord]) -> dict[str, list[TrialRecord]]:
    """Records by environment; scores of different environments are not comparable."""
    return by_environment(records, lambda record: record.trial.environment)


def best_records(records: Sequence[TrialRecord]) -> dict[str, TrialRecord]:
    """The trial with the highest score at any evaluation of each environment; environments without a score are left
    out."""
    bests = {name: _best_record(group) for name, group in records_by_environment(records).items()}
    return {name: best for name, best in bests.items() if best is not None}


def _best_record(records: Sequence[TrialRecord]) -> TrialRecord | None:
    scored = [(record.best.score, -record.trial.index, record) for record in records if record.best is not None]
    return max(scored, key=lambda item: item[:2])[2] if scored else None


def unlisted_trials(
    experiment: Experiment, listed: set[str], parameters: Sequence[str]
) -> tuple[list[Trial], list[Damage]]:
    """Trials that are not in the manifest: those suggested by a search, or all trials if the manifest is lost.

    Args:
        listed: ids of the trials in the manifest.
        parameters: dotted keys that the space varies.

    Returns:
        The trials, read from the `config.yaml` of their folders, and the unusable ones among these files.
    """
    root = experiment.path / "trials"
    folders = [path for path in root.iterdir() if path.name not in listed and path.is_dir()] if root.is_dir() else []
    trials: list[Trial] = []
    damages = []
    for folder in sorted(folders):
        path = folder / "config.yaml"
        if not os.path.lexists(path):
            continue  # created, but nothing was written to it
        try:
            config = parse_recorded(read_settings(path), str(path), shown=True)
            settings = config.as_dict()
            values = {key: _at(settings, key) for key in map(current_key, parameters)}
        except (MskRayError, KeyError, TypeError) as error:
            damages.append(Damage(path, cut(f"no settings of a trial: {error}")))
            continue
        changed = {key: describe(value) for key, value in values.items()}
        trials.append(Trial(len(listed) + len(trials), folder.name, changed, values, config))
    return trials, damages


def _at(settings: Mapping[str, Any], dotted: str) -> Any:
    node: Any = settings
    for part in dotted.split("."):
        node = node[part]
    return node
