"""An ant with slow motors that is asked for a pace, and remembers how hard its torso was hit."""

from collections.abc import Mapping

import torch
from torch import Tensor

from msk_ray import Command, Memory, StepState
from msk_ray.envs.ant.env import Ant


class Remembering(Ant):
    """Commands, and memories with and without a gradient, in control, observation and outcomes."""

    commands = (Command("pace", {"forward": (0.0, 2.0), "rest": (0.0, 1.0)}, every=(0.05, 0.2)),)

    def memories(self) -> Mapping[str, Memory]:
        return {"motor": Memory(8, gradient=True), "hit": Memory(1)}

    def begin_memory(self, state: StepState) -> Mapping[str, Tensor]:
        return {"motor": 0.1 * state.qpos[:, 7:]}

    def remember(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        hit = self.contact_forces(state, 0).norm(dim=-1, keepdim=True)
        return {"motor": self.motor(action), "hit": torch.maximum(0.9 * self.memory["hit"], hit)}

    def motor(self, action: Tensor) -> Tensor:
        """Actions (W, 8) as the motors follow them."""
        return 0.6 * self.memory["motor"] + 0.4 * action

    def control(self, action: Tensor) -> Tensor:
        return super().control(self.motor(action))

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        shown = (self.memory["motor"], 0.01 * self.memory["hit"], self.command("pace"))
        return torch.cat((super().observe(state, action), *shown), -1)

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        return {**super().outcome_terms(state), "hit": self.memory["hit"][:, 0]}
