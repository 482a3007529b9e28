"""The weight of the entropy bonus."""

import math

import torch
from torch import Tensor

from msk_ray.config import EntropyConfig

RATE = 5e-3
"""Change of log α per epoch and nat of missing entropy."""


class EntropyBonus:
    """The coefficient α of −log π in the reward, constant or adapted to hold a target entropy.

    Attributes:
        weight: the current α [reward per nat], a scalar on the device that changes in place.
    """

    def __init__(self, config: EntropyConfig, action_size: int, device: torch.device | str = "cpu") -> None:
        self._config = config
        self._action_size = action_size
        self._coefficient = config.coefficient
        self.weight = torch.tensor(config.coefficient, device=device)

    @property
    def coefficient(self) -> float:
        """The current α [reward per nat]."""
        return self._coefficient

    @coefficient.setter
    def coefficient(self, value: float) -> None:
        self._coefficient = value
        self.weight.fill_(value)

    def bonus(self, neg_log_prob: Tensor) -> Tensor:
        """Rewards for −log π of the actions taken [nat], of the same shape."""
        if not self._config.normalize:
            return self.weight * neg_log_prob
        assert self._config.target is not None
        whole = abs(self._config.target) * self._action_size
        return self.weight * ((neg_log_prob + whole) / (2.0 * whole))

    def adapt(self, entropy: float) -> None:
        """Update with an epoch's mean entropy of the policy [nat]: log α += RATE (target − entropy), by dual ascent.

        The temperature's gradient step of Haarnoja et al. 2018 (arXiv:1812.05905, equation 18), on log α.
        """
        if self._config.target is not None:
            missing = self._config.target * self._action_size - entropy
            self.coefficient *= math.exp(RATE * missing)
