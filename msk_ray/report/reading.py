"""Read an experiment from its files, in any condition: running, finished, crashed, half-written, empty.

Whatever cannot be read is named in `warnings` or in its trial; the rest is shown.
"""

import contextlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from msk_ray.config import parse_settings
from msk_ray.errors import MskRayError, StorageError
from msk_ray.experiment.attempts import FIRST, Attempt
from msk_ray.experiment.damage import Damage, count_damages, describe_damages, read_text
from msk_ray.experiment.environment import read_environment
from msk_ray.experiment.layout import (
    DEVICE_FILE,
    ENVIRONMENT_FILE,
    ERROR_FILE,
    HALVED_FILE,
    MANIFEST_FILE,
    METRICS_FILE,
    OUTCOME_FILE,
    OUTPUT_FILE,
    SPACE_FILE,
    best_checkpoint,
)
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.notes import read_notes
from msk_ray.experiment.outcomes import Ending
from msk_ray.experiment.results import unlisted_trials
from msk_ray.experiment.snapshot import State, TrialReader, TrialSnapshot, file_stamp
from msk_ray.experiment.trial import Trial, by_environment
from msk_ray.files import UnusableFile, last_lines
from msk_ray.metrics import SCORE
from msk_ray.sweep.space import SpaceFile, read_file

_TAIL_LINES = 12
_READ = (METRICS_FILE, OUTCOME_FILE, HALVED_FILE, DEVICE_FILE)
"""A trial is read again when one of these files changes."""
_NOTED = 10
"""Damaged files that are named; further ones are only counted."""


class Condition(StrEnum):
    """What an experiment seems to be doing."""

    RUNNING = "running"
    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    """Trials are unfinished, but none has written anything lately: stopped on request, or crashed."""
    WAITING = "not started"
    EMPTY = "empty"
    """No trial is known."""


@dataclass(frozen=True)
class TrialReading:
    """One trial. E epochs."""

    trial: Trial
    folder: Path
    columns: dict[str, np.ndarray]
    """Every metric by name, shape (E,); NaN where an epoch has no finite value."""
    state: State
    ending: Ending | None = None
    fault: str = ""
    """What is wrong with its files."""
    device: str = ""
    """GPU model, or cpu; empty if it was not recorded."""
    attempt: Attempt = FIRST
    """Scores of an attempt with fewer worlds cannot be compared with the others."""
    note: str = ""
    """What its owner has written about it."""

    @property
    def epochs_done(self) -> int:
        epochs = self.columns.get("epoch")
        return int(epochs[-1]) if epochs is not None and len(epochs) else 0

    @property
    def unrecordable(self) -> bool:
        """Whether its last epoch ran operation by operation because it could not be recorded."""
        column = self.columns.get("train/unrecordable")
        return column is not None and len(column) > 0 and column[-1] == 1.0

    @cached_property
    def curve(self) -> tuple[np.ndarray, np.ndarray]:
        """Env steps and scores of all evaluations with a finite score, both (N,); the first is that of the untrained
        policy."""
        return self.curve_over("env_steps")

    def curve_over(self, column: str) -> tuple[np.ndarray, np.ndarray]:
        """The same over another column of the metrics, such as `seconds`."""
        if SCORE not in self.columns:
            return np.zeros(0), np.zeros(0)
        keep = np.isfinite(self.columns[SCORE]) & np.isfinite(self.columns[column])
        return self.columns[column][keep], self.columns[SCORE][keep]

    @cached_property
    def trained(self) -> tuple[np.ndarray, np.ndarray]:
        """The same without the untrained policy, both (N,); the best of them is the trial's score."""
        if SCORE not in self.columns:
            return np.zeros(0), np.zeros(0)
        keep = np.isfinite(self.columns[SCORE]) & (self.columns["epoch"] > 0)
        return self.columns["env_steps"][keep], self.columns[SCORE][keep]

    @property
    def score(self) -> float | None:
        """Highest finite evaluation score of the trained policy; None before the first."""
        scores = self.trained[1]
        return float(scores.max()) if len(scores) else None

    def last_within(self, env_steps: float) -> float | None:
        """Env steps of the last evaluation of a trained policy within `env_steps`; None if there is none."""
        steps = self.trained[0]
        within = steps[steps <= env_steps]
        return float(within[-1]) if len(within) else None

    def score_within(self, env_steps: float) -> float | None:
        """Highest finite score of the trained policy in the first `env_steps`; None if there is none."""
        steps, scores = self.trained
        within = scores[steps <= env_steps]
        return float(within.max()) if len(within) else None

    @property
    def cut(self) -> bool:
        """Whether it has not reached its end and has not failed: stopped, interrupted or running. Its score might still
        have risen."""
        if self.state is State.ENDED:
            return self.ending is not None and self.ending.cut
        return self.state in (State.RUNNING, State.STALE, State.INTERRUPTED)

    @property
    def best_row(self) -> dict[str, float]:
        """The evaluation with the highest score: its epoch, env steps, and every finite `eval/` metric."""
        if self.score is None:
            return {}
        trained = (self.columns["epoch"] > 0) & np.isfinite(self.columns[SCORE])
        row = int(np.argmax(np.where(trained, self.columns[SCORE], -np.inf)))
        kept = ("epoch", "env_steps", "seconds")
        values = {name: float(v[row]) for name, v in self.columns.items() if name.startswith("eval/") or name in kept}
        return {name: value for name, value in values.items() if math.isfinite(value)}

    @property
    def outcome(self) -> str:
        """How it ended, or what it is doing."""
        if self.state is State.ENDED and self.ending is not None:
            return str(self.ending.outcome)
        return str(self.state)

    @property
    def why(self) -> str:
        parts = (self.attempt, self.ending and self.ending.why, self.fault)
        return "; ".join(str(part) for part in parts if str(part or ""))

    @property
    def failed(self) -> bool:
        return self.state is State.UNREADABLE or (self.ending is not None and self.ending.failed)

    @property
    def best_checkpoint(self) -> Path | None:
        path = best_checkpoint(self.folder)
        return path if path.is_file() else None

    def tail(self) -> str:
        """The last lines of its error, or otherwise of its output."""
        for name in (ERROR_FILE, OUTPUT_FILE):
            with contextlib.suppress(FileNotFoundError):
                try:
                    return "\n".join(last_lines(self.folder / name, _TAIL_LINES))
                except UnusableFile as error:
                    return f"({name}: {error})"
        return ""


@dataclass(frozen=True)
class Reading:
    """An experiment at one moment."""

    experiment: Experiment
    question: str = ""
    created: str = ""
    trials: tuple[TrialReading, ...] = ()
    environment: dict[str, Any] = field(default_factory=dict)
    space: SpaceFile | None = None
    space_text: str = ""
    warnings: tuple[str, ...] = ()
    """What is missing or broken."""
    part: str = ""
    """The environment, if this is the part of the experiment that runs in it."""

    @property
    def name(self) -> str:
        return f"{self.experiment.name}: {self.part}" if self.part else self.experiment.name

    @property
    def condition(self) -> Condition:
        states = {trial.state for trial in self.trials}
        if not states:
            return Condition.EMPTY
        if State.RUNNING in states:
            return Condition.RUNNING
        if states <= {State.ENDED, State.UNREADABLE}:
            return Condition.FINISHED
        return Condition.WAITING if states == {State.WAITING} else Condition.INTERRUPTED

    @property
    def best(self) -> TrialReading | None:
        """The trial with the highest score at any evaluation; None if none has a score."""
        scored = [trial for trial in self.trials if trial.score is not None]
        return max(scored, key=lambda t: (t.score or 0.0, -t.trial.index)) if scored else None

    @property
    def variants(self) -> dict[str, list[TrialReading]]:
        """Trials by variant, that is by everything but the seed, in the order of the experiment."""
        groups: dict[str, list[TrialReading]] = {}
        for trial in self.trials:
            groups.setdefault(trial.trial.variant, []).append(trial)
        return groups

    @property
    def algorithms(self) -> set[str]:
        """Names of the algorithms that trials run."""
        return {trial.trial.config.algorithm.name for trial in self.trials}

    @property
    def environments(self) -> list[str]:
        """Names of the environments that trials run in, in the order of the experiment."""
        return list(dict.fromkeys(trial.trial.environment for trial in self.trials))

    def parts(self) -> list["Reading"]:
        """One reading for each environment, because scores of different environments cannot be compared; itself if
        there is only one.

        Variants of a part are named without the environment that they share.
        """
        groups = by_environment(self.trials, lambda trial: trial.trial.environment)
        if len(groups) < 2:
            return [self]
        return [replace(self, part=name, trials=_without_environment(trials)) for name, trials in groups.items()]

    @property
    def reduced(self) -> list[TrialReading]:
        """Trials that run with half their worlds."""
        return [trial for trial in self.trials if trial.attempt.reduction is not None]

    @property
    def seeds(self) -> set[int]:
        return {trial.trial.seed for trial in self.trials}


def _without_environment(trials: Sequence[TrialReading]) -> tuple[TrialReading, ...]:
    """Trials of one environment, without the parameter that chooses it, unless that parameter sets something else."""
    shared = {key for key in ("env", "env.name") if len({trial.trial.changed.get(key) for trial in trials}) == 1}
    own = ({key: text for key, text in trial.trial.changed.items() if key not in shared} for trial in trials)
    return tuple(
        replace(trial, trial=replace(trial.trial, changed=changed)) for trial, changed in zip(trials, own, strict=True)
    )


def read_experiment(experiment: Experiment, now: float) -> Reading:
    """Read everything there is.

    Args:
        now: seconds since the epoch; tells running trials from silent ones.
    """
    return ExperimentReader(experiment).read(now)


class ExperimentReader:
    """Reads an experiment repeatedly, and each time only what has changed."""

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self._reader = TrialReader()
        self._planned: tuple[Any, list[Trial]] | None = None
        self._unlisted: tuple[Any, tuple[list[Trial], list[Damage]]] | None = None
        self._seen: dict[Path, tuple[Any, TrialReading, tuple[Damage, ...]]] = {}

    def read(self, now: float) -> Reading:
        """The experiment at `now` [s since the epoch]. Never fails because of what its files hold."""
        experiment = self.experiment
        warnings: list[str] = []
        manifest: Mapping[str, Any] = {}
        trials: list[Trial] = []
        if not any(experiment.path.iterdir()):
            warnings.append("The folder is empty.")
        else:
            try:
                manifest = experiment.manifest()
                trials = self._plan()
            except MskRayError as error:
                warnings.append(f"Which trials were planned is not known: {explain(error)}.")
        text, space = _read_space(experiment.path / SPACE_FILE, warnings)
        environment, damages = _read_environment(experiment.path, warnings)
        notes, damaged = read_notes(experiment.path)
        damages += damaged
        unlisted, unreadable = self._others({trial.id for trial in trials}, list(space.parameters) if space else [])
        warnings += [f"A trial is left out: {line}." for line in describe_damages(unreadable, experiment.path)]
        unknown = dict.fromkeys(trial.config.undeclared for trial in [*trials, *unlisted] if trial.config.undeclared)
        warnings += [f"Trials are shown as recorded, and cannot be evaluated here: {why}." for why in unknown]
        readings = []
        for trial in [*trials, *unlisted]:
            reading, damage = self._trial(trial, notes.get(trial.id, ""), now)
            readings.append(reading)
            damages += damage
        if damages:
            lines = describe_damages(damages, experiment.path)
            more = f"; and {len(lines) - _NOTED} more files" if len(lines) > _NOTED else ""
            warnings.append(f"Skipped: {count_damages(damages)}. {'; '.join(lines[:_NOTED])}{more}.")
        if slow := [reading.trial.id for reading in readings if reading.unrecordable]:
            more = f" and {len(slow) - _NOTED} more" if len(slow) > _NOTED else ""
            warnings.append(
                f"Epochs of {', '.join(slow[:_NOTED])}{more} could not be recorded as graphs, and took two to three "
                f"times as long: their {OUTPUT_FILE} says why."
            )
        return Reading(
            experiment,
            str(manifest.get("question") or (space.question.strip() if space else "")),
            str(manifest.get("created", "")),
            tuple(readings),
            environment,
            space,
            text,
            tuple(warnings),
        )

    def _plan(self) -> list[Trial]:
        stamp = file_stamp(self.experiment.path / MANIFEST_FILE)
        if self._planned is None or self._planned[0] != stamp:
            self._planned = stamp, self.experiment.trials(shown=True)
        return self._planned[1]

    def _others(self, listed: set[str], parameters: list[str]) -> tuple[list[Trial], list[Damage]]:
        root = self.experiment.path / "trials"
        folders = sorted(path for path in root.iterdir() if path.name not in listed) if root.is_dir() else []
        key = (len(listed), parameters, [(path.name, file_stamp(path / "config.yaml")) for path in folders])
        if self._unlisted is None or self._unlisted[0] != key:
            self._unlisted = key, unlisted_trials(self.experiment, listed, parameters)
        return self._unlisted[1]

    def _trial(self, trial: Trial, note: str, now: float) -> tuple[TrialReading, tuple[Damage, ...]]:
        folder = self.experiment.trial_folder(trial.id)
        # The planned trial is part of the key because `--extend` gives it more epochs.
        key = (trial, note, [file_stamp(folder / name) for name in _READ])
        seen = self._seen.get(folder)
        if seen is not None and seen[0] == key and seen[1].state is State.ENDED:
            return seen[1:]
        snapshot = self._reader.read(folder, now)
        if seen is not None and seen[0] == key:
            # Whether an unfinished trial counts as running also depends on the time.
            same = seen[1].state is snapshot.state
            reading = seen[1] if same else replace(seen[1], state=snapshot.state)
        else:
            reading = _reading_of(trial, snapshot, note)
        self._seen[folder] = key, reading, snapshot.damages
        return reading, snapshot.damages


def explain(error: Exception) -> str:
    """An error on one line, with its type unless it is one of this package."""
    text = " ".join(str(error).split())
    return text if isinstance(error, MskRayError) else f"{type(error).__name__}: {text}"


def _reading_of(trial: Trial, seen: TrialSnapshot, note: str) -> TrialReading:
    fault = "; ".join(describe_damages(seen.damages, seen.folder))
    columns = columns_of(seen.rows)
    device, attempt = seen.device.name, seen.attempt
    return TrialReading(trial, seen.folder, columns, seen.state, seen.ending, fault, device, attempt, note)


def columns_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Rows of metrics as arrays (E,) by name; missing values are NaN."""
    if not rows:
        return {}
    names: dict[str, None] = dict.fromkeys(("epoch", "env_steps", "seconds"))
    for row in rows:
        names.update(dict.fromkeys(row))
    return {name: np.array([row.get(name, math.nan) for row in rows], dtype=float) for name in names}


def _read_space(path: Path, warnings: list[str]) -> tuple[str, SpaceFile | None]:
    if not os.path.lexists(path):
        warnings.append("space.yaml is missing.")
        return "", None
    try:
        text = read_text(path)
        return text, read_file(parse_settings(text, "space.yaml"), "space.yaml", recorded=True)
    except MskRayError as error:
        warnings.append(f"space.yaml cannot be read: {explain(error)}.")
    return "", None


def _read_environment(folder: Path, warnings: list[str]) -> tuple[dict[str, Any], list[Damage]]:
    if not os.path.lexists(folder / ENVIRONMENT_FILE):
        warnings.append("env.json is missing: versions and command are not known.")
        return {}, []
    return read_environment(folder / ENVIRONMENT_FILE)


def check_folder(experiment: Experiment) -> None:
    """Refuse a folder that cannot be an experiment.

    Raises:
        StorageError: it holds files, but none of an experiment.
    """
    names = [path.name for path in experiment.path.iterdir()]
    if names and not {MANIFEST_FILE, SPACE_FILE, ENVIRONMENT_FILE, "trials"} & set(names):
        raise StorageError(f"{experiment.path} holds no experiment, not even an incomplete one")
