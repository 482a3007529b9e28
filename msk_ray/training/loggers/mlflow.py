"""MLflow."""

import os
import time
from pathlib import Path
from typing import Any, ClassVar

from mlflow.entities import Metric, Param
from mlflow.tracking import MlflowClient

from msk_ray.config import flattened
from msk_ray.files import write_text
from msk_ray.metrics import SCORE
from msk_ray.training.loggers.base import Logger
from msk_ray.training.loggers.run_name import run_name

RUN_FILE = "mlflow_run.txt"
_LONGEST_PARAM = 500
"""Maximum length of a setting's value, which all of MLflow's stores accept."""
_PARAMS_AT_ONCE = 100


class MLflow(Logger):
    """One run per trial, in the MLflow experiment with the sweep's name; its steps are epochs.

    MLFLOW_TRACKING_URI sets the destination, by default `mlflow.db` beside the trial. A resumed trial continues the
    same run, in which repeated rows keep their first values.
    """

    takes_late: ClassVar[bool] = True

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._settings: dict[str, Any] = {}
        self._client: MlflowClient | None = None
        self._run = ""
        self._last = -1
        self._last_scored = -1

    def config(self, settings: dict[str, Any]) -> None:
        """Keep the settings for the run that the first row opens."""
        self._settings = settings

    def write(self, row: dict[str, float]) -> None:
        """Log a row."""
        if self._client is None:
            self._client = self._open()
        if row["epoch"] > self._last:
            self._log(self._client, row)
            self._last = int(row["epoch"])

    def write_late(self, row: dict[str, float]) -> None:
        """Log figures of an earlier row, at its epoch."""
        if self._client is None:
            self._client = self._open()
        if row["epoch"] > self._last_scored:
            self._log(self._client, row)
            self._last_scored = int(row["epoch"])

    def _log(self, client: MlflowClient, row: dict[str, float]) -> None:
        epoch, now = int(row["epoch"]), int(1000 * time.time())
        metrics = [Metric(name, value, now, epoch) for name, value in row.items() if name != "epoch"]
        client.log_batch(self._run, metrics=metrics)

    def close(self) -> None:
        """Mark the run as no longer being written."""
        client, self._client = self._client, None
        if client is not None:
            client.set_terminated(self._run)

    def _open(self) -> MlflowClient:
        client = MlflowClient(os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{self.folder / 'mlflow.db'}")
        path = self.folder / RUN_FILE
        if path.is_file():
            self._run = path.read_text(encoding="utf-8").strip()
            self._last, self._last_scored = (
                max((m.step for m in client.get_metric_history(self._run, name)), default=-1)
                for name in ("env_steps", SCORE)
            )
            client.update_run(self._run, status="RUNNING")
            return client
        experiment, trial = run_name(self.folder)
        existing = client.get_experiment_by_name(experiment)
        number = client.create_experiment(experiment) if existing is None else existing.experiment_id
        self._run = client.create_run(number, run_name=trial).info.run_id
        params = [Param(key, str(value)[:_LONGEST_PARAM]) for key, value in flattened(self._settings).items()]
        for first in range(0, len(params), _PARAMS_AT_ONCE):
            client.log_batch(self._run, params=params[first : first + _PARAMS_AT_ONCE])
        write_text(path, self._run)
        return client
