"""Every disturbance that CartPole can have, and one that remembers what it observed under them."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from msk_ray import Memory, StepState
from msk_ray.envs.cartpole.env import CartPole
from msk_ray.envs.layout import Entry, known

DISTURBANCES: dict[str, Any] = {
    "observation_noise": {"cart_*": {"uniform": 0.5}, "pole_rate": {"normal": 0.2}},
    "observation_bias": {"pole_angle_*": {"uniform": 0.1}},
    "observation_delay": [0, 2],
    "control_delay": [1, 3],
    "control_delay_substeps": [0, 2],
    "push": {"every": [0.02, 0.1], "velocity": {"slider": [0.5]}},
}


class Recalling(CartPole):
    """It observes the five entries of a cart and pole, as they are and as the policy was given them in the two steps
    before."""

    def memories(self) -> Mapping[str, Memory]:
        return {"history": Memory(10, gradient=True)}

    def remember(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        return {"history": self.observation()[:, :10]}

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return torch.cat((super().observe(state, action), self.memory["history"]), dim=-1)

    def observation_layout(self) -> list[Entry]:
        frame = super().observation_layout()
        return [*frame, *known(frame * 2)]
