"""Cheetah along +x; reward, observation and reset as in SHAC's experiments (arXiv:2204.07137)."""

import mujoco
import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.cheetah.config import TERMS, CheetahSettings
from msk_ray.envs.cheetah.model import build_cheetah
from msk_ray.envs.planar import PlanarBody
from msk_ray.step import StepState

_START_HEIGHT = -0.2


class Cheetah(PlanarBody[CheetahSettings]):
    """Observation (17), in this order; source: `envs/cheetah.py` of github.com/NVlabs/DiffRL.

    ====== ==================================================================
    0      torso height above 1 m [m]
    1      pitch [rad]
    2-7    joint angles: thigh, shin and foot of the hind, then fore leg [rad]
    8, 9   torso velocity along x and z [m/s]
    10     pitch rate [rad/s]
    11-16  joint velocities [rad/s]
    ====== ==================================================================
    """

    Settings = CheetahSettings
    terms = TERMS

    @classmethod
    def build_model(cls, config: CheetahSettings, physics: PhysicsConfig) -> mujoco.MjModel:
        return build_cheetah(config, physics)

    def prepare(self) -> None:
        super().prepare()
        self._start = torch.zeros(9, device=self.device)
        self._start[1] = _START_HEIGHT

    def draw_physics(self, count: int) -> StepState:
        qpos, qvel = self._start + 0.1 * self.uniform(count, 9), 0.25 * self.uniform(count, 9)
        return StepState(qpos, qvel, torch.zeros((count, 0), device=self.device))


def forward_vel(env: Cheetah, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """The torso's velocity along +x [m/s]."""
    return obs[:, 8]
