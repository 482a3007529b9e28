"""What bodies with motors that go along +x have in common, and their terms."""

from functools import cached_property
from typing import Any, TypeVar

import mujoco
import torch
from torch import Tensor

from msk_ray.envs.base import Env
from msk_ray.envs.limited_settings import LimitedSettings
from msk_ray.step import StepState

_UNIT = 0.1
"""Overshoot of one joint that counts as 1 [rad]."""
_DEEPEST = -1.0
_DROP = 200.0
"""Weight of the squared depth below the full height [1/m²]."""


def squared_overshoot(angles: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Summed squared overshoot in units of 0.1 rad, (nworld,), of angles (nworld, joints) past the ends of ranges
    (joints,) [rad]."""
    # At most one end of a range is exceeded.
    return (torch.maximum(low - angles, angles - high).clamp_min(0.0) / _UNIT).square().sum(-1)


def worth_of_height(above: Tensor, top: float, weight: float) -> Tensor:
    """What heights above the full height are worth, up to `top` [m]; depths below it cost their squares, up to 1 m."""
    above = above.clamp(_DEEPEST, top)
    return torch.where(above < 0.0, -_DROP * above.square(), weight * above)


LimitedT = TypeVar("LimitedT", bound=LimitedSettings)


class LimitedBody(Env[LimitedT]):
    """A body whose limited joints are hinges, and the last ones of the model; its first joint moves along x."""

    @classmethod
    def reference_settings(cls, config: LimitedT) -> LimitedT:
        return super().reference_settings(config).model_copy(update={"joint_limit_epochs": 0})

    @cached_property
    def joint_ranges(self) -> tuple[int, Tensor, Tensor]:
        """Where the limited joints begin in qpos, and the ends of their ranges (n,) [rad]."""
        first = int(self.model.jnt_limited.argmax())
        assert self.model.jnt_limited[first:].all(), "joints without a range come first"
        assert (self.model.jnt_type[first:] == int(mujoco.mjtJoint.mjJNT_HINGE)).all()
        ranges = self.tensor(self.model.jnt_range[first:])
        low, high = ranges.unbind(-1)
        return int(self.model.jnt_qposadr[first]), low, high

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        return {"vx": state.qvel[:, 0]}


def effort(env: Env[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Summed squared action."""
    return action.square().sum(-1)


def joint_limit(env: LimitedBody[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Summed squared overshoot past the joints' ranges, in units of 0.1 rad."""
    first, low, high = env.joint_ranges
    return squared_overshoot(state.qpos[:, first:], low, high)
