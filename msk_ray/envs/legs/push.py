"""Pushes of the pelvis. Axes: W worlds."""

import math

import torch
from torch import Tensor

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
"""Angle between one push and the next [rad], 137.5°: directions never repeat."""


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
