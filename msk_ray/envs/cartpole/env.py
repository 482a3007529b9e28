"""CartPole swing-up, as in SHAC's experiments (arXiv:2204.07137, appendix)."""

import math

import mujoco
import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.base import Env
from msk_ray.envs.cartpole.config import TERMS, CartPoleSettings
from msk_ray.envs.cartpole.model import build_cartpole
from msk_ray.envs.layout import Entry, entries
from msk_ray.step import StepState

UPRIGHT_ANGLE = 0.3
"""A pole within this angle of upright counts as held [rad]."""


class CartPole(Env[CartPoleSettings]):
    """Observation (5): cart position [m], cart velocity [m/s], sin and cos of the pole angle, its rate [rad/s].

    Starts hanging down, ± π/2 rad, with small velocities. Never terminates; truncated after `episode_length`.
    """

    Settings = CartPoleSettings
    terms = TERMS

    @classmethod
    def build_model(cls, config: CartPoleSettings, physics: PhysicsConfig) -> mujoco.MjModel:
        return build_cartpole(config, physics)

    def prepare(self) -> None:
        self._hanging = self.tensor((0.0, math.pi))
        self._spread = self.tensor((0.5, math.pi / 2))

    def draw_physics(self, count: int) -> StepState:
        qpos = self._hanging + self._spread * self.uniform(count, 2)
        return StepState(qpos, 0.25 * self.uniform(count, 2), torch.zeros((count, 0), device=self.device))

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        x, angle = state.qpos.unbind(-1)
        speed, rate = state.qvel.unbind(-1)
        return torch.stack((x, speed, torch.sin(angle), torch.cos(angle), rate), dim=-1)

    def observation_layout(self) -> list[Entry]:
        return [
            Entry("cart_position", "m"),
            Entry("cart_velocity", "m/s"),
            *entries(("pole_angle_sin", "pole_angle_cos")),
            Entry("pole_rate", "rad/s"),
        ]

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        return {"upright": (wrap_angle(state.qpos[:, 1]).abs() < UPRIGHT_ANGLE).float()}

    def success(self, tail: dict[str, Tensor]) -> Tensor | None:
        return (tail["upright"] > 0).all(0)


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle [rad] in [-π, π)."""
    return torch.remainder(angle + math.pi, 2.0 * math.pi) - math.pi


def pole_angle(env: CartPole, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Squared angle [rad²], wrapped to ±π."""
    return wrap_angle(state.qpos[:, 1]).square()


def pole_velocity(env: CartPole, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Squared angular velocity [rad²/s²]."""
    return state.qvel[:, 1].square()


def cart_position(env: CartPole, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Squared position [m²]."""
    return state.qpos[:, 0].square()


def cart_velocity(env: CartPole, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Squared velocity [m²/s²]."""
    return state.qvel[:, 0].square()


def effort(env: CartPole, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Squared action."""
    return action[:, 0].square()
