"""Where heels and toes are, and how they move. Axes: W worlds."""

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from msk_ray.legs import costs
from msk_ray.legs.gait.body import SIDES, world_axes
from msk_ray.step.autograd.kinematics import Frames
from msk_ray.step.autograd.tangent import quat_rotate

_FOOT = ("calcn", "toes")
"""Bodies whose origins are the heel and the joint of the toes."""


class FootMotion(NamedTuple):
    """Heel and toes of the right foot, then of the left."""

    height: Tensor
    """Above their place in standing [m], (W, 4)."""
    rise: Tensor
    """Upward velocities [m/s], (W, 4)."""
    velocity: Tensor
    """Velocities [m/s], (W, 4, 3)."""

    def sliding(self, phase: Tensor) -> Tensor:
        """Cost (W,) of feet that move while they should stand, at the right leg's phases (W,) [turns]."""
        speed = self.velocity
        return costs.sliding(phase, speed[:, 0], speed[:, 1]) + costs.sliding(phase + 0.5, speed[:, 2], speed[:, 3])

    def hovering(self, phase: Tensor) -> Tensor:
        """Cost (W,) of heels that have not landed when they should, at the right leg's phases (W,) [turns]."""
        heels = self.height[:, 0], self.height[:, 2]
        return costs.hovering(phase, heels[0]) + costs.hovering(phase + 0.5, heels[1])

    def dragging(self, phase: Tensor, clearance: float) -> Tensor:
        """Cost (W,) of feet that are lower than `clearance` [m] in their swing, at the right leg's phases (W,)."""
        right, left = self.height[:, :2], self.height[:, 2:]
        return costs.dragging(phase, right, clearance) + costs.dragging(phase + 0.5, left, clearance)


class Feet:
    """The feet of a model with a keyframe `stand`, in which its pelvis is `stand_height` [m] above the ground."""

    def __init__(self, model: mujoco.MjModel, stand_height: float, device: torch.device) -> None:
        self._names = [f"{body}_{side}" for side in SIDES for body in _FOOT]
        axes = world_axes(model)
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
        mujoco.mj_kinematics(model, data)
        above = [(data.body(name).xpos - data.body("pelvis").xpos) @ axes[2] for name in self._names]
        self._rest = stand_height + torch.tensor(above, dtype=torch.float32, device=device)
        self._up = torch.tensor(axes[2], dtype=torch.float32, device=device)
        # The direction that points forward in standing, in each body's frame.
        ahead = np.stack([data.body(name).xmat.reshape(3, 3).T @ axes[0] for name in self._names])
        self._ahead = torch.tensor(ahead, dtype=torch.float32, device=device)

    def motion(self, frames: Frames, height: Tensor) -> FootMotion:
        """Their motion where the pelvis is at a height (W,) above the ground [m]."""
        above = ((frames.position(self._names) - frames.position("pelvis")[:, None]) * self._up).sum(-1)
        velocity = frames.velocity(self._names)
        return FootMotion(height[:, None] + above - self._rest, (velocity * self._up).sum(-1), velocity)

    def toes(self, frames: Frames) -> tuple[Tensor, Tensor]:
        """Sine of the angle of the toes to the ground, and 2 (1 - cos) of that to their foot, each (W, 2)."""
        quat = frames.orientation(self._names)
        ahead = quat_rotate(quat, self._ahead.to(quat.dtype).expand(len(quat), -1, -1)).unflatten(1, (2, 2))
        foot, toes = ahead.unbind(2)
        return (toes * self._up).sum(-1), (toes - foot).square().sum(-1)
