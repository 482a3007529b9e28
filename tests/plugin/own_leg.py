"""A reward term of one's own for the legs of 26 muscles: a cost of bouncing."""

import torch
from torch import Tensor

from msk_ray import StepState
from msk_ray.config.sections import NonNegative
from msk_ray.legs.config import LegReward
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.env import MyoLeg26


class Reward(LegReward):
    """Adds the weight of the new term, which is also its weight in scores."""

    bounce: NonNegative = 0.5
    """Weight of the pelvis's squared vertical velocity [s²/m²]."""


class Settings(MyoLeg26Settings):
    """The legs' settings with that reward."""

    reward: Reward = Reward()


class SmoothLegs(MyoLeg26):
    """Legs that should not bounce."""

    Settings = Settings
    reward_names = (*MyoLeg26.reward_names, "bounce")

    def reward_terms(self, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
        bounce = -self.config.reward.bounce * self.root(state).velocity[:, 2].square()
        return torch.cat((super().reward_terms(state, action, obs), bounce[:, None]), dim=-1)
