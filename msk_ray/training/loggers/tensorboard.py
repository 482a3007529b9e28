"""TensorBoard's event files in a trial's folder."""

from pathlib import Path
from typing import ClassVar

from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import SummaryWriter

from msk_ray.training.loggers.base import Logger

_PROGRESS = ("env_steps", "seconds", "env_steps_per_s")
_SCHEDULED = ("train/horizon", "train/actor_lr")
_TERM = "eval/term/"


def board_tag(name: str) -> str:
    """The TensorBoard tag of a metric: the part before the slash is the group of its chart.

    `env_steps` → `progress/env_steps`, `eval/term/x` → `eval_terms/x`, `train/actor_lr` → `schedule/actor_lr`; others
    keep their names.
    """
    if name in _PROGRESS:
        return f"progress/{name}"
    if name in _SCHEDULED:
        return f"schedule/{name.split('/', 1)[1]}"
    return f"eval_terms/{name.removeprefix(_TERM)}" if name.startswith(_TERM) else name


class TensorBoard(Logger):
    """One chart per metric over epochs; rows that a resumed trial repeats are hidden."""

    takes_late: ClassVar[bool] = True

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._board: SummaryWriter | None = None

    def rewind(self, epoch: int) -> None:
        """Hide later epochs in earlier files."""
        self._board = SummaryWriter(str(self.folder), purge_step=epoch + 1)

    def write(self, row: dict[str, float]) -> None:
        """Log a row."""
        if self._board is None:
            self._board = SummaryWriter(str(self.folder))
        values = [
            Summary.Value(tag=board_tag(name), simple_value=value) for name, value in row.items() if name != "epoch"
        ]
        # One event for all: `add_scalar` would lock the writer's queue for each value.
        assert self._board.file_writer is not None, "it is open"
        self._board.file_writer.add_summary(Summary(value=values), int(row["epoch"]))

    def write_late(self, row: dict[str, float]) -> None:
        """Log figures of an earlier row, at its epoch."""
        self.write(row)

    def close(self) -> None:
        """Flush and close the file."""
        board, self._board = self._board, None
        if board is not None:
            board.close()
