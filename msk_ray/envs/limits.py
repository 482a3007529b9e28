"""How far joints are past the ends of their ranges, as a cost."""

from typing import TypeVar

import mujoco
import torch
from torch import Tensor

from msk_ray.config.sections import LimitedSettings
from msk_ray.envs.base import Env
from msk_ray.step import StepState

_UNIT = 0.1
"""Overshoot of one joint that counts as 1 [rad]."""


def squared_overshoot(angles: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Summed squared overshoot in units of 0.1 rad, (nworld,), of angles (nworld, joints) past the ends of ranges
    (joints,) [rad]."""
    # At most one end of a range is exceeded.
    return (torch.maximum(low - angles, angles - high).clamp_min(0.0) / _UNIT).square().sum(-1)


LimitedT = TypeVar("LimitedT", bound=LimitedSettings)


class LimitedBody(Env[LimitedT]):
    """A body that training can charge for joints past their ranges (`reward.joint_limit`), by less and less where
    `joint_limit_epochs` says so. Its limited joints are hinges, and the last ones of the model."""

    begin_epoch_in_place = True

    @classmethod
    def reference_settings(cls, config: LimitedT) -> LimitedT:
        return super().reference_settings(config).model_copy(update={"joint_limit_epochs": 0})

    def prepare(self) -> None:
        super().prepare()
        if self.config.reward.joint_limit > 0.0:
            self.reward_names = (*type(self).reward_names, "joint_limit")
            first = int(self.model.jnt_limited.argmax())
            assert self.model.jnt_limited[first:].all(), "joints without a range come first"
            assert (self.model.jnt_type[first:] == int(mujoco.mjtJoint.mjJNT_HINGE)).all()
            self._first_limited = int(self.model.jnt_qposadr[first])
            ranges = torch.tensor(self.model.jnt_range[first:], dtype=torch.float32, device=self.device)
            self._low, self._high = ranges.unbind(-1)
        self._limit_share = torch.ones((), device=self.device)
        """How much of `joint_limit` is left."""

    def begin_epoch(self, epoch: int) -> None:
        super().begin_epoch(epoch)
        if self.config.joint_limit_epochs:
            self._limit_share.fill_(max(0.0, 1.0 - epoch / self.config.joint_limit_epochs))

    def with_limit_cost(self, terms: Tensor, state: StepState) -> Tensor:
        """Reward terms (W, T), and behind them the cost of `state`, (W, T + 1), if it has a weight."""
        weight = self.config.reward.joint_limit
        if weight == 0.0:
            return terms
        overshoot = squared_overshoot(state.qpos[:, self._first_limited :], self._low, self._high)
        cost = -weight * overshoot[:, None]
        if self.config.joint_limit_epochs:
            cost = self._limit_share * cost
        return torch.cat((terms, cost), dim=-1)
