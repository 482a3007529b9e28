"""Pushes of the pelvis at fixed intervals, by `env.push`: off by default, and the condition `push` of evaluations.

Nothing is drawn; the pushes of `envs.pushes` are drawn at random, by `physics.randomize`, in training.

Axes: W worlds.
"""

import math

import torch
from torch import Tensor

from msk_ray.legs.config import PushConfig
from msk_ray.step import StepState

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
"""Angle between one push and the next [rad], 137.5°: directions never repeat."""


def pushed(state: StepState, age: Tensor, config: PushConfig, timestep: float, slides: Tensor) -> StepState:
    """A state as a step begins with it, after a push if one is due.

    Args:
        age: env steps of each world's episode, (W,).
        config: size and interval of the pushes.
        timestep: of a control step [s].
        slides: speeds of the first three degrees of freedom for 1 m/s forward, and to the left, (2, 3).
    """
    if config.speed == 0.0:
        return state
    change = pushes(age, max(1, round(config.interval / timestep)), config.speed)
    moved = state.qvel[:, :3] + change[:, :1] * slides[0] + change[:, 1:] * slides[1]
    return state._replace(qvel=torch.cat((moved, state.qvel[:, 3:]), dim=-1))


def pushes(age: Tensor, every: int, speed: float) -> Tensor:
    """Changes of the velocity forward and to the left [m/s], (W, 2), after `age` env steps, (W,).

    Args:
        age: of each world's episode.
        every: env steps from one push to the next; the first comes after as many.
        speed: size of the change [m/s].
    """
    turn = _GOLDEN_ANGLE * (age // every + torch.arange(len(age), device=age.device))
    size = speed * ((age > 0) & (age % every == 0))
    return torch.stack((size * torch.cos(turn), size * torch.sin(turn)), dim=-1)
