"""The length of the next rollout."""

import math
from collections.abc import Mapping
from typing import Any

from msk_ray.algorithms.shac.cotangent_gate import Norms
from msk_ray.algorithms.shac.schedules import adapted_horizon, contact_horizon
from msk_ray.config import AdaptiveHorizon, ContactHorizon, HorizonSchedule


class RolloutLength:
    """Constant, by schedule, or following the epochs' cotangents or contact forces."""

    def __init__(self, config: int | HorizonSchedule | AdaptiveHorizon | ContactHorizon) -> None:
        self._config = config
        self._length = float(config.start) if isinstance(config, AdaptiveHorizon | ContactHorizon) else None
        self._multiplier = 0.0

    def at(self, epoch: int) -> int:
        """Env steps H of the rollout at an epoch, counted from 0."""
        if isinstance(self._config, AdaptiveHorizon | ContactHorizon):
            assert self._length is not None
            return round(self._length)
        return self._config if isinstance(self._config, int) else self._config.at(epoch)

    def follow(self, norms: Norms | None, contact: float | None) -> None:
        """Adapt the horizon to an epoch's cotangents, or to its contact force [body weights] if measured."""
        if isinstance(self._config, AdaptiveHorizon):
            assert self._length is not None
            self._length = adapted_horizon(self._config, self._length, math.nan if norms is None else float(norms.p90))
        elif isinstance(self._config, ContactHorizon):
            assert self._length is not None
            assert contact is not None
            self._length, self._multiplier = contact_horizon(self._config, self._length, self._multiplier, contact)

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` needs."""
        return {"horizon": self._length, "horizon_multiplier": self._multiplier}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._length, self._multiplier = state["horizon"], state["horizon_multiplier"]
