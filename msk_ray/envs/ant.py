"""Ant running along +x; reward, observation, reset and termination as in SHAC's experiments (arXiv:2204.07137)."""

import math

import mujoco
import torch
from torch import Tensor

from msk_ray.config import AntEnvConfig, PhysicsConfig
from msk_ray.config.schema import VARIANTS
from msk_ray.envs.base import Env
from msk_ray.envs.models.ant import STAND_HEIGHT, STAND_JOINTS, build_ant
from msk_ray.simulation import StepState
from msk_ray.simulation.tangent import quat_exp, quat_multiply, quat_rotate

_JOINT_VELOCITY_SCALE = 0.1


class Ant(Env[AntEnvConfig]):
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

    obs_size = 37
    variants = VARIANTS["ant"]

    @staticmethod
    def build_model(config: AntEnvConfig, physics: PhysicsConfig) -> mujoco.MjModel:
        return build_ant(config, physics)

    def draw_physics(self) -> StepState:
        stand = torch.tensor([0.0, 0.0, STAND_HEIGHT, 1.0, 0.0, 0.0, 0.0, *STAND_JOINTS], device=self.device)
        position = stand[:3] + 0.1 * self.uniform(3)
        axis = torch.nn.functional.normalize(self.uniform(3), dim=-1)
        rotation = quat_multiply(stand[3:7].expand(self.nworld, 4), quat_exp(math.pi / 24 * self.uniform(1) * axis))
        joints = stand[7:] + 0.2 * self.uniform(8)
        qvel = 0.25 * self.uniform(14)
        return StepState(
            torch.cat((position, rotation, joints), -1), qvel, torch.zeros((self.nworld, 0), device=self.device)
        )

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        orientation = state.qpos[:, 3:7]
        up, heading = self._axes(orientation)
        return torch.cat(
            (
                state.qpos[:, 2:3],
                orientation,
                state.qvel[:, 0:3],
                quat_rotate(orientation, state.qvel[:, 3:6]),  # MuJoCo's angular velocity is in the body frame
                state.qpos[:, 7:],
                _JOINT_VELOCITY_SCALE * state.qvel[:, 6:],
                up[:, None],
                heading[:, None],
                action,
            ),
            dim=-1,
        )

    def reward_terms(self, state: StepState, action: Tensor) -> dict[str, Tensor]:
        c = self.config
        up, heading = self._axes(state.qpos[:, 3:7])
        return {
            "forward_vel": c.forward_vel * state.qvel[:, 0],
            "up": c.up * up,
            "heading": c.heading * heading,
            "height": c.height * (state.qpos[:, 2] - c.termination_height),
            "action": -c.action_penalty * (action**2).sum(-1),
        }

    def fell(self, state: StepState) -> Tensor:
        if not self.config.early_termination:
            return super().fell(state)
        return state.qpos[:, 2] < self.config.termination_height

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        return {"vx": state.qvel[:, 0]}

    @staticmethod
    def _axes(orientation: Tensor) -> tuple[Tensor, Tensor]:
        """World z of the torso's z axis and world x of its x axis, each (W,), from rotation matrix entries."""
        w, x, y, z = orientation.unbind(-1)
        return w * w - x * x - y * y + z * z, w * w + x * x - y * y - z * z
