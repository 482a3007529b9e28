"""Ant running along +x; reward, observation, reset and termination as in SHAC's experiments (arXiv:2204.07137)."""

import math

import mujoco
import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.ant.config import TERMS, AntSettings
from msk_ray.envs.ant.model import STAND_HEIGHT, STAND_JOINTS, build_ant
from msk_ray.envs.floating import JOINT_VELOCITY_SCALE, FloatingBody
from msk_ray.step import StepState
from msk_ray.step.autograd.tangent import quat_exp, quat_multiply, quat_rotate


class Ant(FloatingBody[AntSettings]):
    """Observation (37), in this order:

    ====== ===========================================================
    0      torso height [m]
    1-4    torso orientation, quaternion (w, x, y, z)
    5-7    torso linear velocity, world frame [m/s]
    8-10   torso angular velocity, world frame [rad/s]
    11-18  joint angles [rad], hip and ankle of legs 1-4
    19-26  joint velocities × 0.1 [rad/s]
    27     cosine between the torso's up axis and +z
    28     cosine between the torso's forward axis and +x
    29-36  last action
    ====== ===========================================================
    """

    Settings = AntSettings
    terms = TERMS
    cosine_names = ("up_cosine", "forward_cosine")

    @classmethod
    def build_model(cls, config: AntSettings, physics: PhysicsConfig) -> mujoco.MjModel:
        return build_ant(config, physics)

    def prepare(self) -> None:
        super().prepare()
        # World z of the torso's z axis and world x of its x axis are w² - x² - y² + z² and w² + x² - y² - z².
        self._axes = self.tensor(((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)))
        self._stand = self.tensor((0.0, 0.0, STAND_HEIGHT, 1.0, 0.0, 0.0, 0.0, *STAND_JOINTS))

    def draw_physics(self, count: int) -> StepState:
        stand = self._stand
        position = stand[:3] + 0.1 * self.uniform(count, 3)
        axis = torch.nn.functional.normalize(self.uniform(count, 3), dim=-1)
        rotation = quat_multiply(stand[3:7].expand(count, 4), quat_exp(math.pi / 24 * self.uniform(count, 1) * axis))
        joints = stand[7:] + 0.2 * self.uniform(count, 8)
        qvel = 0.25 * self.uniform(count, 14)
        return StepState(torch.cat((position, rotation, joints), -1), qvel, torch.zeros((count, 0), device=self.device))

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        orientation = state.qpos[:, 3:7]
        return torch.cat(
            (
                state.qpos[:, 2:7],
                state.qvel[:, 0:3],
                quat_rotate(orientation, state.qvel[:, 3:6]),  # MuJoCo's angular velocity is in the body frame
                state.qpos[:, 7:],
                JOINT_VELOCITY_SCALE * state.qvel[:, 6:],
                orientation.square() @ self._axes,
                action,
            ),
            dim=-1,
        )


def up(env: Ant, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Cosine between the torso's up axis and +z."""
    return obs[:, 27]


def heading(env: Ant, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Cosine between the torso's forward axis and +x."""
    return obs[:, 28]


def height(env: Ant, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """The torso's height above `env.termination_height` [m]."""
    return obs[:, 0] - env.config.termination_height
