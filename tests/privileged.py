"""CartPole of which the critic sees something other than the policy."""

import torch
from torch import Tensor

from msk_ray.config.commands import Command
from msk_ray.envs.cartpole.env import CartPole
from msk_ray.step import StepState


class Alike(CartPole):
    """The critic sees what the policy sees, by a method of its own."""

    def observe_critic(self, state: StepState, action: Tensor) -> Tensor:
        return self.observe(state, action)


class Privileged(CartPole):
    """The policy sees positions only, the critic velocities and the action too."""

    obs_size = 2

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return state.qpos.clone()

    def observe_critic(self, state: StepState, action: Tensor) -> Tensor:
        return torch.cat((state.qpos, state.qvel, action), dim=-1)


class Commanded(Privileged):
    """With a command, whose settings are of a class that no module names."""

    commands = (Command("pace", {"forward": (0.0, 2.0)}),)


class Broken(Privileged):
    """What the critic sees is not finite where the cart is to the right."""

    def observe_critic(self, state: StepState, action: Tensor) -> Tensor:
        return torch.cat((state.qpos, state.qvel, state.qpos[:, :1].neg().sqrt()), dim=-1)
