"""What bodies on legs whose torso is free have in common."""

from typing import Any, ClassVar, TypeVar

from torch import Tensor

from msk_ray.envs.layout import Entry, each, entries, known, vector
from msk_ray.envs.limited_body import LimitedBody
from msk_ray.envs.limited_settings import FallingSettings
from msk_ray.step import StepState

JOINT_VELOCITY_SCALE = 0.1
"""Of joint velocities in the observation."""

FallingT = TypeVar("FallingT", bound=FallingSettings)


class FloatingBody(LimitedBody[FallingT]):
    """A body that observes height, orientation and velocities of its torso, angles and rates of its hinges, two cosines
    and the last action."""

    cosine_names: ClassVar[tuple[str, str]]

    def observation_layout(self) -> list[Entry]:
        hinges = [self.model.joint(i).name for i in range(1, self.model.njnt)]
        return [
            Entry("torso_height", "m"),
            *entries(f"torso_quaternion_{axis}" for axis in "wxyz"),
            *vector("torso_velocity", "m/s"),
            *vector("torso_angular_velocity", "rad/s"),
            *each(hinges, "angle", "rad"),
            *each(hinges, "rate", "10 rad/s"),
            *entries(self.cosine_names),
            *known(entries(f"last_action_{i}" for i in range(self.action_size))),
        ]

    def fell(self, state: StepState) -> Tensor:
        if not self.config.early_termination:
            return super().fell(state)
        return state.qpos[:, 2] < self.config.termination_height


def forward_vel(env: FloatingBody[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """The torso's velocity along +x [m/s]."""
    return obs[:, 5]
