"""Humanoid along +x; reward, observation, reset and termination as in SHAC's experiments (arXiv:2204.07137)."""

import math

import mujoco
import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.floating import JOINT_VELOCITY_SCALE, FloatingBody
from msk_ray.envs.humanoid.config import TERMS, HumanoidSettings
from msk_ray.envs.humanoid.model import START_HEIGHT, build_humanoid
from msk_ray.envs.limited_body import worth_of_height
from msk_ray.step import StepState
from msk_ray.step.autograd.tangent import quat_exp, quat_rotate

_TARGET = 200.0
_FULL_HEIGHT = 0.84
"""Height of the torso that costs and earns nothing [m]."""
_TOP = 0.1
"""Largest height above it that earns something [m]."""


class Humanoid(FloatingBody[HumanoidSettings]):
    """Observation (76), in this order; source: `envs/humanoid.py` of github.com/NVlabs/DiffRL.

    ====== ==========================================================================================
    0      torso height [m]
    1-4    torso orientation, quaternion (w, x, y, z)
    5-7    torso linear velocity, world frame [m/s]
    8-10   torso angular velocity, world frame [rad/s]
    11-31  joint angles [rad]: abdomen z, y, x; right leg, left leg (hip x, z, y, knee, ankle y, x);
           right arm, left arm (shoulder 1, 2, elbow)
    32-52  joint velocities × 0.1 [rad/s]
    53     cosine between the torso's up axis and +z
    54     cosine between the torso's forward axis and the way to (200 m, 0)
    55-75  last action
    ====== ==========================================================================================
    """

    Settings = HumanoidSettings
    terms = TERMS
    cosine_names = ("up_cosine", "heading_cosine")

    @classmethod
    def build_model(cls, config: HumanoidSettings, physics: PhysicsConfig) -> mujoco.MjModel:
        return build_humanoid(config, physics)

    def prepare(self) -> None:
        super().prepare()
        self._forward = self.tensor((1.0, 0.0, 0.0))
        self._target = self.tensor((_TARGET, 0.0))
        self._start = self.tensor((0.0, 0.0, START_HEIGHT))

    def draw_physics(self, count: int) -> StepState:
        position = self._start + 0.1 * self.uniform(count, 3)
        axis = torch.nn.functional.normalize(self.uniform(count, 3), dim=-1)
        rotation = quat_exp(math.pi / 24 * self.uniform(count, 1) * axis)
        qpos = torch.cat((position, rotation, 0.2 * self.uniform(count, 21)), -1)
        return StepState(qpos, 0.25 * self.uniform(count, 27), torch.zeros((count, 0), device=self.device))

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        orientation = state.qpos[:, 3:7]
        forward = quat_rotate(orientation, self._forward.expand(len(orientation), 3))
        way = torch.nn.functional.normalize(self._target - state.qpos[:, 0:2], dim=-1)
        return torch.cat(
            (
                state.qpos[:, 2:7],
                state.qvel[:, 0:3],
                quat_rotate(orientation, state.qvel[:, 3:6]),  # MuJoCo's angular velocity is in the body frame
                state.qpos[:, 7:],
                JOINT_VELOCITY_SCALE * state.qvel[:, 6:],
                # World z of the torso's z axis is 1 - 2 (x² + y²).
                1.0 - 2.0 * orientation[:, 1:3].square().sum(-1, keepdim=True),
                (forward[:, 0:2] * way).sum(-1, keepdim=True),
                action,
            ),
            dim=-1,
        )


def up(env: Humanoid, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Cosine between the torso's up axis and +z."""
    return obs[:, 53]


def heading(env: Humanoid, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Cosine between the torso's forward axis and the way to a point 200 m ahead of the start."""
    return obs[:, 54]


def height(env: Humanoid, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """What the torso's height above or below the full height is worth."""
    return worth_of_height(obs[:, 0] - _FULL_HEIGHT, _TOP, env.config.reward.height)
