"""A trial's varied settings, for TensorBoard's table of hyperparameters."""

import time
from pathlib import Path

from msk_ray.errors import StorageFailure
from msk_ray.experiment.trial import Trial
from msk_ray.metrics import BEST_SCORE, SCORE

METRICS = (BEST_SCORE, SCORE, "progress/env_steps")
"""Scalars of the trial that the table shows with its settings."""


FILE = "events.out.tfevents.0000000000.hparams"
"""Event file of the settings. TensorBoard reads the files of a folder in the order of their names, which begin with the
second they were made, and follows the last one. Zero puts the settings before the scalars: within one second, the
numbers at the end of usual names decide, as text, and 10 comes before 9."""


def log_hparams(folder: Path, trial: Trial) -> None:
    """Write a trial's settings into an event file of its folder; the scores come from the trial's own scalars.

    A trial without the logger `tensorboard` has no such file. A further attempt writes the same file.

    Raises:
        StorageFailure: the disk is full or the folder not writable.
    """
    if "tensorboard" not in trial.config.execution.loggers:
        return
    # These load torch, which importing this module should not.
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
    """Seed and changed parameters by name: numbers unchanged, everything else as text."""
    found: dict[str, float | str] = {"seed": trial.seed}
    for key, text in trial.changed.items():
        value = trial.values.get(key)
        found[key] = value if isinstance(value, int | float) else text
    return found
