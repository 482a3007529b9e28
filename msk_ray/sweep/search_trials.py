"""Trials suggested by a search. Its choices are recorded in the trials' folders, for resuming."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from msk_ray.config import current_values, parse_recorded, read_yaml
from msk_ray.errors import ConfigError, StorageError
from msk_ray.experiment.damage import DamagedFile, read_object
from msk_ray.experiment.layout import CONFIG_FILE, PARAMS_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.trial import Trial, trial_id
from msk_ray.files import write_json
from msk_ray.sweep.space import Space
from msk_ray.sweep.trials import base_settings, make_trial


@dataclass(frozen=True)
class SearchTrial:
    """A trial, with the search's choice."""

    trial: Trial
    params: dict[str, Any]
    """Dotted key → value; the label for a value of a list."""


def search_trial(space: Space, base: Mapping[str, Any], params: Mapping[str, Any]) -> Trial:
    """The trial for a search's choice."""
    values, changed = {}, {}
    for key, op in space.sampled.items():
        level = op.recorded(params[key])
        values[key], changed[key] = level.value, level.label
    return make_trial(space, base, changed, values, space.seeds[0], 0)


def write_params(folder: Path, params: Mapping[str, Any]) -> None:
    """Record a search's choice in the trial's folder, once: `recover` orders trials by the age of these files."""
    if not (folder / PARAMS_FILE).exists():
        write_json(folder / PARAMS_FILE, dict(params))


def recover(experiment: Experiment, space: Space) -> list[SearchTrial]:
    """All trials that a search has suggested so far, numbered in the order in which they were started.

    Raises:
        StorageError: the current space gives other trials.
    """
    base = base_settings(space)
    files = sorted(experiment.path.glob(f"trials/*/{PARAMS_FILE}"), key=lambda path: (path.stat().st_mtime, path))
    trials: list[SearchTrial] = []
    for file in files:
        try:
            recorded = read_object(file, dict)
        except DamagedFile as error:
            advice = f"the search's choice is not known: remove {file.parent}, and the search suggests another trial"
            raise DamagedFile(error.damage, advice) from None
        if recorded is None:
            continue  # removed in the meantime
        params = current_values(recorded)
        try:
            trial = search_trial(space, base, params)
        except (ConfigError, KeyError) as error:
            raise _changed(file, f"{error}") from error
        if trial.id != file.parent.name:
            trial = replace(trial, id=_recorded_id(file, trial))
        trials.append(SearchTrial(replace(trial, index=len(trials)), params))
    return trials


def _recorded_id(file: Path, trial: Trial) -> str:
    """The id under which an equal trial is recorded; version 0.2 computed other ids.

    Raises:
        StorageError: the recorded trial has other settings.
    """
    config = file.parent / CONFIG_FILE
    if not config.exists() or trial_id(parse_recorded(read_yaml(config), str(config))) != trial.id:
        raise _changed(file, f"it gives {trial.id} for them")
    return file.parent.name


def _changed(file: Path, why: str) -> StorageError:
    return StorageError(
        f"--resume: the space no longer gives the trial of {file}: {why}; undo that, or pass another --name"
    )
