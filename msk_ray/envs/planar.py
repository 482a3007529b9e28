"""What bodies in a vertical plane have in common, whose first joints are the slides and the hinge of their root."""

import mujoco
import torch
from torch import Tensor

from msk_ray.envs.layout import Entry
from msk_ray.envs.limited_body import LimitedBody, LimitedT
from msk_ray.step import StepState


class PlanarBody(LimitedBody[LimitedT]):
    """A body whose observation is its coordinates, all but x, and the velocities of all, in the order of its joints."""

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return torch.cat((state.qpos[:, 1:], state.qvel), dim=-1)

    def observation_layout(self) -> list[Entry]:
        slides = self.model.jnt_type == int(mujoco.mjtJoint.mjJNT_SLIDE)
        names = [self.model.joint(i).name for i in range(self.model.njnt)]
        places = [
            Entry(f"{name}_position", "m") if slide else Entry(f"{name}_angle", "rad")
            for name, slide in zip(names, slides, strict=True)
        ]
        rates = [
            Entry(f"{name}_velocity", "m/s") if slide else Entry(f"{name}_rate", "rad/s")
            for name, slide in zip(names, slides, strict=True)
        ]
        return [*places[1:], *rates]
