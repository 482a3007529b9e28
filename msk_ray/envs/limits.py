"""How far joints are past the ends of their ranges, as a cost."""

import torch
from torch import Tensor

_UNIT = 0.1
"""Overshoot of one joint that counts as 1 [rad]."""


def squared_overshoot(angles: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Summed squared overshoot in units of 0.1 rad, (nworld,), of angles (nworld, joints) past the ends of ranges
    (joints,) [rad]."""
    # At most one end of a range is exceeded.
    return (torch.maximum(low - angles, angles - high).clamp_min(0.0) / _UNIT).square().sum(-1)
