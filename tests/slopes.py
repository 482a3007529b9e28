"""Gradients of functions of a state against differences of their own values."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor


def check_slopes(
    value: Callable[[list[Tensor]], Tensor],
    parts: Sequence[NDArray[np.floating]],
    rng: np.random.Generator,
    *,
    step: float = 1e-3,
    rel: float = 1e-2,
    abs: float = 2e-2,
    free: bool = True,
) -> None:
    """Compare the gradient of `value` in each part of a state with a central difference along a random direction.

    Args:
        value: a number from the parts, float32, each with a row for one world.
        parts: qpos first.
        rng: draws the directions.
        step: half the distance of the two points of a difference.
        rel, abs: tolerances, as for `pytest.approx`.
        free: whether entries 3 to 6 of qpos are a unit quaternion, along whose sphere the direction goes.
    """
    inputs = [torch.tensor(p[None], dtype=torch.float32, requires_grad=True) for p in parts]
    gradients = torch.autograd.grad(value(inputs), inputs)
    for which, gradient in enumerate(gradients):
        direction = rng.normal(size=parts[which].shape)
        if which == 0 and free:
            direction[3:7] -= parts[0][3:7] * (direction[3:7] @ parts[0][3:7])
        along = torch.tensor(direction, dtype=torch.float32)
        ends = []
        for sign in (1, -1):
            moved = [torch.tensor(p[None], dtype=torch.float32) for p in parts]
            moved[which] = moved[which] + sign * step * along
            with torch.no_grad():
                ends.append(float(value(moved)))
        slope = float((gradient[0] * along).sum())
        assert slope == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=rel, abs=abs)
