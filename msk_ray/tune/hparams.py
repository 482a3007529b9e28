"""A trial's varied settings, for TensorBoard's table of hyperparameters."""

from pathlib import Path

from msk_ray.errors import StorageFailure
from msk_ray.experiment.trial import Trial

METRICS = ("eval/best_score", "eval/score", "progress/env_steps")
"""Scalars of the trial that the table shows with its settings."""


def log_hparams(folder: Path, trial: Trial) -> None:
    """Write a trial's settings into an event file of its folder; the scores come from the trial's own scalars.

    A trial without the logger `tensorboard` has no such file.

    Call it before those are written: TensorBoard reads the files of a folder in the order of their age, and then
    follows the newest one.

    Raises:
        StorageFailure: the disk is full or the folder not writable.
    """
    if "tensorboard" not in trial.config.trial.loggers:
        return
    # Loads torch, which importing this module should not.
    from torch.utils.tensorboard import SummaryWriter
    from torch.utils.tensorboard.summary import hparams

    experiment, session, _ = hparams(hparams_of(trial), dict.fromkeys(METRICS, 0.0))
    try:
        with SummaryWriter(str(folder)) as board:
            writer = board.file_writer
            assert writer is not None
            writer.add_summary(experiment)
            writer.add_summary(session)
    except OSError as error:
        raise StorageFailure(f"cannot write {folder}: {error.strerror or error}") from error


def hparams_of(trial: Trial) -> dict[str, float | str]:
    """Seed and changed parameters by name: numbers unchanged, everything else as text."""
    found: dict[str, float | str] = {"seed": trial.seed}
    for key, text in trial.changed.items():
        value = trial.values.get(key)
        found[key] = value if isinstance(value, int | float) else text
    return found
