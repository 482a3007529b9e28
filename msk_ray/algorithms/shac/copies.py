"""Worlds that start an epoch as perturbed copies of others. G groups of C worlds each, W = G·C."""

from typing import Any

import torch
from torch import Tensor

from msk_ray.config import PerturbedCopies
from msk_ray.envs import Env, EnvState
from msk_ray.step import StepState


def from_first(values: Tensor, count: int) -> Tensor:
    """Values (W, ...) in which every world of a group has those of its first world."""
    return values[::count].repeat_interleave(count, dim=0)


def spread(state: EnvState, config: PerturbedCopies, env: Env[Any], generator: torch.Generator) -> EnvState:
    """The state in which all worlds but the first of each group are perturbed copies of that.

    Perturbations are uniform along each degree of freedom. A joint may leave its range, as it may while moving.
    """
    physics, *others = EnvState(
        StepState(*(from_first(t, config.count) for t in state.physics)),
        *(from_first(t, config.count) for t in state[1:]),
    )
    shape = (env.group.size * env.nworld, env.model.nv)
    copied = (torch.arange(env.nworld, device=env.device) % config.count > 0)[:, None]
    shifts = [
        (2.0 * env.group.own(torch.rand(shape, generator=generator, device=env.device)) - 1.0) * copied * size
        for size in (config.qpos, config.qvel)
    ]
    moved = env.sim.tangent.integrate(physics.qpos, shifts[0])
    qpos = torch.where(copied, moved, physics.qpos)
    return EnvState(StepState(qpos, physics.qvel + shifts[1], physics.act), *others)
