"""Which worlds have diverged.

Axes: W worlds.
"""

import torch
from torch import Tensor

from msk_ray.step import StepState

_STATE_BOUND = 1e6
"""Largest absolute value of a state, in its units: no model here reaches it as long as the solver works."""


@torch.no_grad()
def diverged_worlds(state: StepState) -> Tensor:
    """Worlds (W,) bool whose state is beyond all bounds or not finite."""
    # NaN compares false, so one comparison finds both.
    return ~(torch.cat(state, dim=-1).abs() < _STATE_BOUND).all(-1)
