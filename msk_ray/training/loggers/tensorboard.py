"""TensorBoard's event files in a trial's folder."""

from pathlib import Path

import numpy as np
from torch.utils.tensorboard import SummaryWriter

from msk_ray.errors import StorageFailure
from msk_ray.training.loggers.base import Logger

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


class TensorBoard(Logger):
    """A chart a figure over epochs; of a resumed trial, the rows that it went back behind are hidden."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._board: SummaryWriter | None = None

    def rewind(self, epoch: int) -> None:
        """Hide what earlier files say of later epochs."""
        self._board = SummaryWriter(str(self.folder), purge_step=epoch + 1)

    def write(self, row: dict[str, float]) -> None:
        """Take in a row."""
        if self._board is None:
            self._board = SummaryWriter(str(self.folder))
        for name, value in row.items():
            if name != "epoch":
                self._board.add_scalar(board_tag(name), value, int(row["epoch"]))

    def close(self) -> None:
        """Flush and close the file."""
        board, self._board = self._board, None
        if board is not None:
            board.close()


def log_image(folder: Path, tag: str, image: np.ndarray, epoch: int) -> None:
    """Put a picture into TensorBoard.

    Args:
        folder: of its event file; not that of a trial's scalars, whose own file TensorBoard would then leave.
        tag: the chart's name.
        image: shape (height, width, 3), uint8.
        epoch: where it stands.

    Raises:
        StorageFailure: the disk is full or the folder not writable.
    """
    try:
        with SummaryWriter(str(folder)) as board:
            board.add_image(tag, image, epoch, dataformats="HWC")
    except OSError as error:
        raise StorageFailure(f"cannot write {folder}: {error.strerror or error}") from error
