"""Status of single training runs (`python -m msk_ray.train`), read from their files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msk_ray.config import env_name, read_yaml
from msk_ray.errors import MskRayError
from msk_ray.experiment.damage import describe_damages
from msk_ray.experiment.layout import CONFIG_FILE, MANIFEST_FILE, METRICS_FILE
from msk_ray.experiment.metrics import TrialProgress
from msk_ray.experiment.ownership import has_living_owner
from msk_ray.experiment.snapshot import State, TrialReader

FOLDER = "train"
"""Default subfolder of a storage folder for training runs."""


@dataclass(frozen=True)
class Training:
    """Status of a training run."""

    name: str
    """Its folder, relative to the storage folder."""
    environment: str
    epochs: int
    """Planned epochs; 0 if unknown."""
    state: State
    progress: TrialProgress
    note: str = ""
    """What is wrong with its files."""


class TrainingReader:
    """Reads the training runs of a storage folder repeatedly; unchanged metrics files are not read again."""

    def __init__(self, storage: Path) -> None:
        self._storage = storage
        self._reader = TrialReader(keep_rows=False)

    def look(self, now: float) -> list[Training]:
        """All training runs at `now` [s since the epoch], by name."""
        return [self._training(folder, now) for folder in find_trainings(self._storage)]

    def _training(self, folder: Path, now: float) -> Training:
        seen = self._reader.read(folder, now)
        notes = describe_damages(seen.damages, folder)
        settings: Mapping[str, Any] = {}
        try:
            # Read as plain data, because its environment's class may not be installed here.
            settings = read_yaml(folder / CONFIG_FILE)
        except MskRayError as error:
            notes.append(str(error))
        trial = settings.get("trial")
        planned = trial.get("epochs") if isinstance(trial, Mapping) else None
        epochs = planned if isinstance(planned, int) else 0
        state = seen.state
        if 0 < epochs <= seen.progress.epoch:
            state = State.ENDED
        elif (owned := has_living_owner(folder, now)) is not None:
            state = State.RUNNING if owned else State.INTERRUPTED
        name = str(folder.relative_to(self._storage))
        return Training(name, env_name(settings) or "", epochs, state, seen.progress, "; ".join(notes))


def find_trainings(storage: Path) -> list[Path]:
    """Folders of training runs in a storage folder and in its subfolder `train`."""
    folders = [
        path
        for parent in (storage, storage / FOLDER)
        if parent.is_dir()
        for path in parent.iterdir()
        if (path / METRICS_FILE).is_file() and not (path / MANIFEST_FILE).exists()
    ]
    return sorted(folders)
