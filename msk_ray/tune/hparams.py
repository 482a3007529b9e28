"""A trial's varied settings, for TensorBoard's table of hyperparameters."""

import time
from pathlib import Path

from msk_ray.errors import StorageFailure
from msk_ray.experiment.trial import Trial
from msk_ray.metrics import BEST_SCORE, SCORE

METRICS = (BEST_SCORE, SCORE, "progress/env_steps")
"""Scalars that the table shows beside a trial's settings."""


FILE = "events.out.tfevents.0000000000.hparams"
"""Event file of the settings. TensorBoard reads a folder's files in order of their names, which begin with the time of
their creation, and follows the last one. Time 0 puts the settings before the scalars."""


def log_hparams(folder: Path, trial: Trial) -> None:
    """Write a trial's settings to an event file in its folder; scores come from the trial's scalars.

    Does nothing for trials without the logger `tensorboard`. A further attempt overwrites the file.

    Raises:
        StorageFailure: the disk is full or the folder not writable.
    """
    if "tensorboard" not in trial.config.execution.loggers:
        return
    # imported here, because they load torch
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.summary.writer.record_writer import RecordWriter
    from torch.utils.tensorboard.summary import hparams

    experiment, session, _ = hparams(hparams_of(trial), dict.fromkeys(METRICS, 0.0))
    now = time.time()
    try:
        with (folder / FILE).open("wb") as file:
            records = RecordWriter(file)
            for event in (
                Event(wall_time=now, file_version="brain.Event:2"),
                Event(wall_time=now, summary=experiment),
                Event(wall_time=now, summary=session),
            ):
                records.write(event.SerializeToString())
    except OSError as error:
        raise StorageFailure(f"cannot write {folder}: {error.strerror or error}") from error


def hparams_of(trial: Trial) -> dict[str, float | str]:
    """Seed and varied parameters by name: numbers unchanged, everything else as text."""
    hparams: dict[str, float | str] = {"seed": trial.seed}
    for key, text in trial.changed.items():
        value = trial.values.get(key)
        hparams[key] = value if isinstance(value, int | float) else text
    return hparams
