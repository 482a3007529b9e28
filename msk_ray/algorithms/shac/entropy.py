"""The weight of the entropy bonus."""

import math

from msk_ray.config import EntropyConfig


class EntropyBonus:
    """The coefficient α of −log π in the reward, constant or adapted to hold a target entropy.

    Attributes:
        coefficient: the current α [reward per nat].
    """

    def __init__(self, config: EntropyConfig, action_size: int) -> None:
        self._config = config
        self._action_size = action_size
        self.coefficient = config.coefficient

    def adapt(self, entropy: float) -> None:
        """Update with an epoch's mean entropy of the policy [nat]: log α += rate (target − entropy), by dual ascent.

        The temperature's gradient step of Haarnoja et al. 2018 (arXiv:1812.05905, equation 18), on log α.
        """
        if self._config.target is not None:
            missing = self._config.target * self._action_size - entropy
            self.coefficient *= math.exp(self._config.rate * missing)
