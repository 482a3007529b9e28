"""A trial's own record: one JSON object a line, flushed as it happens, and TensorBoard beside it."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter

from msk_ray.errors import StorageFailure
from msk_ray.experiment.damage import Damage
from msk_ray.experiment.layout import METRICS_FILE
from msk_ray.experiment.metrics import load_metrics
from msk_ray.files import write_bytes

_PROGRESS = ("env_steps", "seconds", "env_steps_per_s")
_SCHEDULED = ("train/horizon", "train/actor_lr")
_TERM = "eval/term/"


def board_tag(name: str) -> str:
    """The TensorBoard tag of a metric: what comes before the slash is the group its chart is shown in.

    `env_steps` → `progress/env_steps`, `eval/term/x` → `eval_terms/x`, `train/actor_lr` → `schedule/actor_lr`; others
    keep their names.
    """
    if name in _PROGRESS:
        return f"progress/{name}"
    if name in _SCHEDULED:
        return f"schedule/{name.split('/', 1)[1]}"
    return f"eval_terms/{name.removeprefix(_TERM)}" if name.startswith(_TERM) else name


class MetricsLog:
    """Appends rows to `metrics.jsonl` and TensorBoard in a trial's folder.

    A value that is not finite is written as null and named in the row's `nonfinite` list: JSON has no NaN.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / METRICS_FILE
        self._board: SummaryWriter | None = None
        self._folder = folder

    def rewind(self, epoch: int) -> tuple[Damage, ...]:
        """Drop rows after `epoch`, which a resumed trial will write again, and with them what is damaged.

        Returns:
            The damaged lines.

        Raises:
            StorageFailure: the rows cannot be read or written.
        """
        if not self._path.is_file():
            return ()
        metrics = load_metrics(self._path)
        rows = [row for row in metrics.rows if row["epoch"] <= epoch]
        write_bytes(self._path, "".join(json.dumps(row) + "\n" for row in rows).encode())
        self.close()
        self._board = SummaryWriter(str(self._folder), purge_step=epoch + 1)
        return metrics.damages

    def write(self, row: dict[str, float]) -> None:
        """Append one row; it is on its way to disk when this returns.

        Raises:
            StorageFailure: the disk is full or gone.
        """
        bad = [name for name, value in row.items() if not math.isfinite(value)]
        clean: dict[str, Any] = {name: None if name in bad else value for name, value in row.items()}
        clean["epoch"] = int(row["epoch"])
        if bad:
            clean["nonfinite"] = bad
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(clean) + "\n")
                file.flush()
                os.fsync(file.fileno())
            if self._board is None:
                self._board = SummaryWriter(str(self._folder))
            for name, value in row.items():
                if name not in bad and name != "epoch":
                    self._board.add_scalar(board_tag(name), value, clean["epoch"])
        except OSError as error:
            raise StorageFailure(f"cannot write {self._path}: {error.strerror or error}") from error

    def close(self) -> None:
        """Flush and close TensorBoard's file.

        Raises:
            StorageFailure: its last events could not be written; the rows are in `metrics.jsonl` all the same.
        """
        board, self._board = self._board, None
        if board is None:
            return
        try:
            board.close()
        except OSError as error:
            raise StorageFailure(f"cannot write TensorBoard's events: {error.strerror or error}") from error


def log_image(folder: Path, tag: str, image: np.ndarray, epoch: int) -> None:
    """Put a picture into TensorBoard.

    Args:
        folder: of its event file; not that of a trial's scalars, whose own file TensorBoard would then leave.
        image: shape (height, width, 3), uint8.

    Raises:
        StorageFailure: the disk is full or the folder not writable.
    """
    try:
        with SummaryWriter(str(folder)) as board:
            board.add_image(tag, image, epoch, dataformats="HWC")
    except OSError as error:
        raise StorageFailure(f"cannot write {folder}: {error.strerror or error}") from error
