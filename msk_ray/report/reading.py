"""Read an experiment from its files, in any condition: running, finished, crashed, half-written, empty.

Whatever cannot be read is named in `warnings` or in its trial; the rest is shown.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from msk_ray.config import parse_settings
from msk_ray.errors import MskRayError, StorageError
from msk_ray.experiment.damage import Damage, DamagedFile, count_damages, describe_damages, read_text
from msk_ray.experiment.layout import ENVIRONMENT_FILE, MANIFEST_FILE, OUTPUT_FILE, SPACE_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.notes import load_notes
from msk_ray.experiment.provenance import read_environment
from msk_ray.experiment.records import ExperimentReader, TrialRecord, best_record, records_by_environment
from msk_ray.experiment.snapshot import State
from msk_ray.experiment.trial import Trial
from msk_ray.sweep.space import SpaceFile, read_file

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
class Reading:
    """An experiment at one moment."""

    experiment: Experiment
    question: str = ""
    created: str = ""
    trials: tuple[TrialRecord, ...] = ()
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
        if states == {State.ENDED}:
            return Condition.FINISHED
        return Condition.WAITING if states == {State.WAITING} else Condition.INTERRUPTED

    @property
    def best(self) -> TrialRecord | None:
        """The trial with the highest score at any evaluation; None if none has a score."""
        return best_record(self.trials)

    @property
    def variants(self) -> dict[str, list[TrialRecord]]:
        """Trials by variant, that is by everything but the seed, in the order of the experiment."""
        groups: dict[str, list[TrialRecord]] = {}
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
        groups = records_by_environment(self.trials)
        if len(groups) < 2:
            return [self]
        return [replace(self, part=name, trials=_without_environment(trials)) for name, trials in groups.items()]

    @property
    def reduced(self) -> list[TrialRecord]:
        """Trials that run with half their worlds."""
        return [trial for trial in self.trials if trial.attempt.reduction is not None]

    @property
    def seeds(self) -> set[int]:
        return {trial.trial.seed for trial in self.trials}


def scores_of(trials: Sequence[TrialRecord]) -> list[float]:
    """The scores of the trials that have one."""
    return [trial.score for trial in trials if trial.score is not None]


def _without_environment(trials: Sequence[TrialRecord]) -> tuple[TrialRecord, ...]:
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
    return read_again(ExperimentReader(experiment), now)


def read_again(reader: ExperimentReader, now: float) -> Reading:
    """The same with a reader, which reads only what has changed. Never fails because of what the files hold."""
    experiment = reader.experiment
    warnings: list[str] = []
    manifest: Mapping[str, Any] = {}
    planned: list[Trial] = []
    if not any(experiment.path.iterdir()):
        warnings.append("The folder is empty.")
    else:
        try:
            manifest = experiment.manifest()
            planned = reader.planned()
        except MskRayError as error:
            warnings.append(f"Which trials were planned is not known: {explain(error)}.")
    text, space = _read_space(experiment.path / SPACE_FILE, warnings)
    environment, damages = _read_environment(experiment.path, warnings)
    notes = {}
    try:
        notes = load_notes(experiment.path)
    except DamagedFile as error:
        damages.append(error.damage)
    records, unreadable = reader.look(now, planned, notes)
    damages += [damage for record in records for damage in record.damages]
    warnings += [f"A trial is left out: {line}." for line in describe_damages(unreadable, experiment.path)]
    unknown = dict.fromkeys(r.trial.config.undeclared for r in records if r.trial.config.undeclared)
    warnings += [f"Trials are shown as recorded, and cannot be evaluated here: {why}." for why in unknown]
    if damages:
        lines = describe_damages(damages, experiment.path)
        more = f"; and {len(lines) - _NOTED} more files" if len(lines) > _NOTED else ""
        warnings.append(f"Skipped: {count_damages(damages)}. {'; '.join(lines[:_NOTED])}{more}.")
    if slow := [r.trial.id for r in records if r.rows and r.rows[-1].get("train/unrecordable") == 1.0]:
        more = f" and {len(slow) - _NOTED} more" if len(slow) > _NOTED else ""
        warnings.append(
            f"Epochs of {', '.join(slow[:_NOTED])}{more} could not be recorded as graphs, and took two to three "
            f"times as long: their {OUTPUT_FILE} says why."
        )
    return Reading(
        experiment,
        str(manifest.get("question") or (space.question.strip() if space else "")),
        str(manifest.get("created", "")),
        tuple(records),
        environment,
        space,
        text,
        tuple(warnings),
    )


def explain(error: Exception) -> str:
    """An error on one line, with its type unless it is one of this package."""
    text = " ".join(str(error).split())
    return text if isinstance(error, MskRayError) else f"{type(error).__name__}: {text}"


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
