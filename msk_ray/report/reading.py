"""An experiment as its files show it, in whatever condition: running, finished, crashed, half-written, empty.

What cannot be read is named in `notes`, or in the trial it belongs to; it never hides the rest.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from msk_ray.config import current_key, describe_fault, parse_recorded, read_yaml
from msk_ray.errors import MskRayError, StorageError
from msk_ray.metrics_file import METRICS_FILE, read_metrics
from msk_ray.tune.experiment import SPACE_FILE, Experiment
from msk_ray.tune.halved import Halved, read_halved
from msk_ray.tune.operators import describe
from msk_ray.tune.outcomes import Ending, read_ending
from msk_ray.tune.space import SpaceFile
from msk_ray.tune.standing import DEVICE_FILE, OUTPUT_FILE, State, heartbeat_age, is_silent, progress_of
from msk_ray.tune.stopping import SCORE
from msk_ray.tune.trials import Trial

ERROR_FILE = "error.txt"
_TAIL_LINES = 12
_UNREADABLE = (MskRayError, OSError, ValueError, KeyError, TypeError)


class Condition(StrEnum):
    """What an experiment seems to be doing."""

    RUNNING = "running"
    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    """Trials are left, and none shows a sign of life: stopped on request, or crashed."""
    WAITING = "not started"
    EMPTY = "empty"
    """No trial is known."""


@dataclass(frozen=True)
class TrialReading:
    """One trial. E epochs."""

    trial: Trial
    folder: Path
    columns: dict[str, np.ndarray]
    """Every metric by name, shape (E,); NaN where an epoch has none, or no number."""
    state: State
    ending: Ending | None = None
    note: str = ""
    """What is wrong with its files."""
    device: str = ""
    """GPU model, or cpu; empty if it was not recorded."""
    halved: Halved | None = None
    """Set if it runs with half its worlds: then its scores do not compare with the others'."""

    @property
    def epochs_done(self) -> int:
        epochs = self.columns.get("epoch")
        return int(epochs[-1]) if epochs is not None and len(epochs) else 0

    @cached_property
    def curve(self) -> tuple[np.ndarray, np.ndarray]:
        """Env steps and scores of the evaluations with a finite score, both (N,); that of the untrained policy, from
        which a curve begins, is among them."""
        if SCORE not in self.columns:
            return np.zeros(0), np.zeros(0)
        keep = np.isfinite(self.columns[SCORE])
        return self.columns["env_steps"][keep], self.columns[SCORE][keep]

    @cached_property
    def trained(self) -> tuple[np.ndarray, np.ndarray]:
        """The same of the trained policy alone, both (N,): what counts as its score."""
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
        """Whether it stands before its end without having failed: stopped, interrupted or running. Given more, its
        score might have risen."""
        if self.state is State.ENDED:
            return self.ending is not None and self.ending.cut
        return self.state in (State.RUNNING, State.STALE)

    @property
    def best_row(self) -> dict[str, float]:
        """The evaluation with the highest score: its epoch, env steps, and every `eval/` figure that is a number."""
        if self.score is None:
            return {}
        trained = (self.columns["epoch"] > 0) & np.isfinite(self.columns[SCORE])
        row = int(np.argmax(np.where(trained, self.columns[SCORE], -np.inf)))
        kept = ("epoch", "env_steps", "seconds")
        found = {name: float(v[row]) for name, v in self.columns.items() if name.startswith("eval/") or name in kept}
        return {name: value for name, value in found.items() if math.isfinite(value)}

    @property
    def outcome(self) -> str:
        """Name of its ending, or what it is doing."""
        if self.state is State.ENDED and self.ending is not None:
            return str(self.ending.outcome)
        return "interrupted" if self.state is State.STALE else str(self.state)

    @property
    def why(self) -> str:
        parts = (self.halved, self.note or (self.ending and self.ending.why))
        return "; ".join(str(part) for part in parts if part)

    @property
    def failed(self) -> bool:
        return self.state is State.UNREADABLE or (self.ending is not None and self.ending.failed)

    @property
    def best_checkpoint(self) -> Path | None:
        path = self.folder / "checkpoints" / "best.pt"
        return path if path.is_file() else None

    def tail(self) -> str:
        """The last lines of what it stumbled over, or else of its output."""
        for name in (ERROR_FILE, OUTPUT_FILE):
            path = self.folder / name
            if path.is_file():
                lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
                return "\n".join(lines[-_TAIL_LINES:])
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
    notes: tuple[str, ...] = ()
    """What is missing or broken."""

    @property
    def name(self) -> str:
        return self.experiment.name

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
        """Trials by variant, which is everything but the seed; in order of the experiment."""
        groups: dict[str, list[TrialReading]] = {}
        for trial in self.trials:
            groups.setdefault(trial.trial.variant, []).append(trial)
        return groups

    @property
    def halved(self) -> list[TrialReading]:
        """Trials that run with half their worlds."""
        return [trial for trial in self.trials if trial.halved is not None]

    @property
    def seeds(self) -> set[int]:
        return {trial.trial.seed for trial in self.trials}


def read_experiment(experiment: Experiment, now: float) -> Reading:
    """Read everything there is.

    Args:
        now: seconds since the epoch, to tell running trials from silent ones.
    """
    notes: list[str] = []
    manifest: Mapping[str, Any] = {}
    trials: list[Trial] = []
    if not any(experiment.path.iterdir()):
        notes.append("The folder is empty.")
    else:
        try:
            manifest = experiment.manifest()
            trials = experiment.trials()
        except _UNREADABLE as error:
            notes.append(f"Which trials were planned is not known: {explain(error)}.")
    text, space = _read_space(experiment.path / SPACE_FILE, notes)
    readings = [_read_trial(trial, experiment.trial_folder(trial.id), now) for trial in trials]
    readings += _unlisted(experiment, {trial.id for trial in trials}, space, notes, now)
    return Reading(
        experiment,
        str(manifest.get("question") or (space.question.strip() if space else "")),
        str(manifest.get("created", "")),
        tuple(readings),
        _read_environment(experiment.path / "env.json", notes),
        space,
        text,
        tuple(notes),
    )


def explain(error: Exception) -> str:
    """An error on one line, without its type if it is one of ours."""
    text = " ".join(str(error).split())
    return text if isinstance(error, MskRayError) else f"{type(error).__name__}: {text}"


def _read_trial(trial: Trial, folder: Path, now: float) -> TrialReading:
    try:
        rows = read_metrics(folder / METRICS_FILE)
        columns = columns_of(rows)
        ending = read_ending(folder)
        progress = progress_of([_numbers(row) for row in rows[-12:]])
        device = _device(folder / DEVICE_FILE)
        halved = read_halved(folder)
    except _UNREADABLE as error:
        return TrialReading(trial, folder, {}, State.UNREADABLE, note=explain(error))
    age = heartbeat_age(folder, now)
    if ending is not None:
        state = State.ENDED
    elif age is None:
        state = State.WAITING
    else:
        state = State.STALE if is_silent(folder, progress, age) else State.RUNNING
    return TrialReading(trial, folder, columns, state, ending, device=device, halved=halved)


def _device(path: Path) -> str:
    return str(json.loads(path.read_text(encoding="utf-8"))["name"]) if path.is_file() else ""


def columns_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Rows of metrics as arrays (E,) by name; what a row lacks, or has as null, is NaN."""
    names: dict[str, None] = {}
    for row in rows:
        names.update(dict.fromkeys(row))
    names.pop("nonfinite", None)
    return {name: np.array([row.get(name) for row in rows], dtype=float) for name in names}


def _numbers(row: Mapping[str, Any]) -> dict[str, float]:
    return {k: math.nan if v is None else v for k, v in row.items() if k != "nonfinite"}


def _unlisted(
    experiment: Experiment, listed: set[str], space: SpaceFile | None, notes: list[str], now: float
) -> list[TrialReading]:
    """Trials that the manifest does not know: those a search has made up, or all if it is lost."""
    root = experiment.path / "trials"
    folders = (
        sorted(path for path in root.iterdir() if path.is_dir() and path.name not in listed) if root.is_dir() else []
    )
    found: list[TrialReading] = []
    for folder in folders:
        path = folder / "config.yaml"
        if not path.is_file():
            continue  # made, but nothing was written into it
        try:
            config = parse_recorded(read_yaml(path), str(path))
            settings = config.as_dict()
            varied = [current_key(key, config.env.name) for key in (space.parameters if space else {})]
            values = {key: _at(settings, key) for key in varied}
        except _UNREADABLE as error:
            notes.append(f"trials/{folder.name} is left out, its settings cannot be read: {explain(error)}.")
            continue
        trial = Trial(
            len(listed) + len(found), folder.name, {k: describe(v) for k, v in values.items()}, values, config
        )
        found.append(_read_trial(trial, folder, now))
    return found


def _at(settings: Mapping[str, Any], dotted: str) -> Any:
    node: Any = settings
    for part in dotted.split("."):
        node = node[part]
    return node


def _read_space(path: Path, notes: list[str]) -> tuple[str, SpaceFile | None]:
    if not path.is_file():
        notes.append("space.yaml is missing.")
        return "", None
    try:
        text = path.read_text(encoding="utf-8")
        return text, SpaceFile.model_validate(read_yaml(path))
    except ValidationError as error:
        notes.append(f"space.yaml cannot be read: {describe_fault(error, SpaceFile)}.")
    except _UNREADABLE as error:
        notes.append(f"space.yaml cannot be read: {explain(error)}.")
    return "", None


def _read_environment(path: Path, notes: list[str]) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        notes.append("env.json is missing: versions and command are not known.")
        return {}
    except (OSError, ValueError) as error:
        notes.append(f"env.json cannot be read: {explain(error)}.")
        return {}
    return data if isinstance(data, dict) else {}


def check_folder(experiment: Experiment) -> None:
    """Refuse a folder that cannot be an experiment.

    Raises:
        StorageError: it holds files, and none that an experiment begins with.
    """
    names = [path.name for path in experiment.path.iterdir()]
    if names and not {"manifest.json", SPACE_FILE, "env.json", "trials"} & set(names):
        raise StorageError(f"{experiment.path} holds no experiment (nor the beginning of one)")
