"""How much of the springs at the pelvis is left."""

from collections.abc import Mapping
from typing import Any

import torch

from msk_ray.envs.legs.config import AssistConfig


class Assistance:
    """Share of the springs' stiffness, which falls with the epochs that count.

    Args:
        config: the schedule.
        timestep: of a control step [s].
        device: of `share`.

    Attributes:
        share: a number on the device, changed in place.
        reads_episode_lengths: the setting, if any, because of which `end_epoch` needs the length.
    """

    def __init__(self, config: AssistConfig, timestep: float, device: torch.device) -> None:
        self._config = config
        self._timestep = timestep
        self._passed = 0
        self.reads_episode_lengths = "env.assist.steady" if config.epochs and config.steady is not None else None
        self.share = torch.tensor(config.at(0), device=device)

    def begin_epoch(self, epoch: int) -> None:
        """Set the share of an epoch, counted from 0."""
        if self._config.steady is None:
            self._passed = epoch
        self.share.fill_(self._config.at(self._passed))

    def end_epoch(self, length: float | None) -> dict[str, float]:
        """Count an epoch that had this many env steps per episode that ended; its share, by metric name.

        With `steady`, the length must be known (`Env.reads_episode_lengths`).
        """
        if not self._config.epochs:
            return {}
        stood = self._config.at(self._passed)
        if self._config.steady is not None:
            assert length is not None
            self._passed += length * self._timestep >= self._config.steady
        return {"train/assist": stood}

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` needs."""
        return {} if self._config.steady is None else {"assist_epochs": self._passed}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        if self._config.steady is not None:
            self._passed = state["assist_epochs"]
