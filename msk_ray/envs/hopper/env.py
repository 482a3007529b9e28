"""Hopper along +x; reward, observation, reset and termination as in SHAC's experiments (arXiv:2204.07137)."""

import math

import mujoco
import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.hopper.config import TERMS, HopperSettings
from msk_ray.envs.hopper.model import build_hopper
from msk_ray.envs.limited_body import worth_of_height
from msk_ray.envs.planar import PlanarBody
from msk_ray.step import StepState

_FULL_ANGLE = math.pi / 6
_FULL_HEIGHT = -0.3
"""Height of the torso, from 1.25 m, that costs and earns nothing [m]."""
_TOP = 0.3
"""Largest height above it that earns something [m]."""


class Hopper(PlanarBody[HopperSettings]):
    """Observation (11), in this order; source: `envs/hopper.py` of github.com/NVlabs/DiffRL.

    ===== ===================================================
    0     torso height above 1.25 m [m]
    1     pitch [rad]
    2-4   joint angles: thigh, leg, foot [rad]
    5, 6  torso velocity along x and z [m/s]
    7     pitch rate [rad/s]
    8-10  joint velocities [rad/s]
    ===== ===================================================
    """

    Settings = HopperSettings
    terms = TERMS

    @classmethod
    def build_model(cls, config: HopperSettings, physics: PhysicsConfig) -> mujoco.MjModel:
        return build_hopper(config, physics)

    def draw_physics(self, count: int) -> StepState:
        qpos, qvel = 0.05 * self.uniform(count, 6), 0.05 * self.uniform(count, 6)
        return StepState(qpos, qvel, torch.zeros((count, 0), device=self.device))

    def fell(self, state: StepState) -> Tensor:
        if not self.config.early_termination:
            return super().fell(state)
        return state.qpos[:, 1] < self.config.termination_height


def forward_vel(env: Hopper, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """The torso's velocity along +x [m/s]."""
    return obs[:, 5]


def height(env: Hopper, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """What the torso's height above or below the full height is worth."""
    return worth_of_height(obs[:, 0] - _FULL_HEIGHT, _TOP, env.config.reward.height)


def upright(env: Hopper, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """1 − (pitch / 30°)²."""
    return 1.0 - (obs[:, 1] / _FULL_ANGLE).square()
