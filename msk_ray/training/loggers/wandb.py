"""Weights & Biases."""

import os
from pathlib import Path
from typing import Any

import wandb

from msk_ray.training.loggers.base import Logger
from msk_ray.training.loggers.run_name import run_id, run_name

RUN_FILE = "wandb_run.txt"


class Wandb(Logger):
    """One run per trial, in the project WANDB_PROJECT (by default msk_ray); its steps are epochs.

    W&B's own environment variables set the destination; WANDB_MODE=offline keeps the run in the trial's folder for
    `wandb sync`. A resumed trial continues the same run, in which repeated rows keep their first values.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._settings: dict[str, Any] = {}
        self._run: Any = None

    def config(self, settings: dict[str, Any]) -> None:
        """Keep the settings for the run that the first row opens."""
        self._settings = settings

    def write(self, row: dict[str, float]) -> None:
        """Log a row."""
        if self._run is None:
            experiment, trial = run_name(self.folder)
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "msk_ray"),
                dir=str(self.folder),
                id=run_id(self.folder, RUN_FILE),
                group=experiment,
                name=trial,
                resume="allow",
                reinit="create_new",
                settings=wandb.Settings(silent=True, console="off"),
            )
            self._run.config.update(self._settings, allow_val_change=True)
        self._run.log(row, step=int(row["epoch"]))

    def close(self) -> None:
        """Finish the run."""
        run, self._run = self._run, None
        if run is not None:
            run.finish()
