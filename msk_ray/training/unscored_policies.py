"""Policies waiting to be scored."""

import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

from msk_ray.errors import CheckpointError
from msk_ray.training.checkpoint import read_checkpoint, unscored_checkpoints, unscored_path, write_checkpoint


class UnscoredPolicies:
    """Trial states whose policies still have to be scored, stored as files, so that they survive a crash.

    Args:
        folder: the trial's checkpoint folder.

    Attributes:
        epochs: epochs of the states, oldest first.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.epochs: list[int] = []
        self._since = 0.0

    @property
    def waited_s(self) -> float:
        """How long the oldest one has waited in this process [s]; 0 if there is none."""
        return time.monotonic() - self._since if self.epochs else 0.0

    def add(self, state: dict[str, Any]) -> None:
        """Store a trial state, to score its policy later.

        Raises:
            StorageFailure: the disk is full or gone.
        """
        epoch = state["epoch"]
        write_checkpoint(unscored_path(self._folder, epoch), state, {"epoch": epoch})
        if not self.epochs:
            self._since = time.monotonic()
        self.epochs.append(epoch)

    def state(self, epoch: int) -> dict[str, Any]:
        """The state at an epoch, on the CPU.

        Raises:
            CheckpointError: its file is missing or torn.
        """
        return read_checkpoint(unscored_path(self._folder, epoch))

    def remove(self, epoch: int) -> None:
        """Remove the state of an epoch, whose score has been recorded."""
        unscored_path(self._folder, epoch).unlink()
        self.epochs.remove(epoch)

    def rewind(self, epoch: int, scored: Collection[int]) -> list[str]:
        """Keep only states up to `epoch` that have no score yet, when a trial continues from there.

        Returns:
            A line for each unreadable state, which gets no score.
        """
        self.epochs, self._since, faults = [], time.monotonic(), []
        for number, path in unscored_checkpoints(self._folder):
            if number <= epoch and number not in scored:
                try:
                    read_checkpoint(path)
                except CheckpointError as error:
                    faults.append(f"{error}; the policy of epoch {number} gets no score")
                else:
                    self.epochs.append(number)
                    continue
            path.unlink()
        return faults
