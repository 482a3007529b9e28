"""The shared part of muscle-driven legs: excitation, observation of muscles, reward, falls and outcomes.

Axes: W worlds, U muscles, N hinges of the legs.
"""

import math
from abc import abstractmethod
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.config.physics import CONTACTS, LIMITS
from msk_ray.envs.base import Env
from msk_ray.envs.layout import Entry, entries
from msk_ray.envs.legs.config import LegSettings
from msk_ray.envs.legs.muscles import MuscleCurves
from msk_ray.simulation import StepState

AnyLegSettings = TypeVar("AnyLegSettings", bound=LegSettings)

_GRAVITY = 9.81
_TRUNK_LEVER = 0.18
"""How far the centre of mass moves with the trunk's up axis [m]: 34 kg of 75 kg, 0.4 m above the pelvis."""
_LIMIT_MARGIN = 0.05
"""Distance from a joint limit at which the penalty starts [rad]."""
_LIMIT_UNIT = 0.1
_VELOCITY_SCALE = 0.1
"""Scale of joint velocities in the observation [s/rad]."""


class Root(NamedTuple):
    """The pelvis in the world, each (W,) or (W, k), world frame: x forward, y left, z up."""

    height: Tensor
    """Height above the ground [m]."""
    up: Tensor
    """The trunk's up axis, (W, 3)."""
    heading: Tensor
    """Cosine between the pelvis's forward axis and +x."""
    place: Tensor
    """Forward and to the left of the start [m], (W, 2)."""
    pose: Tensor
    """Position and orientation in the observation (W, k)."""
    velocity: Tensor
    """Velocity [m/s], (W, 3)."""
    spin: Tensor
    """Angular velocity [rad/s], (W, 3)."""


def stride_error(angles: Tensor, rates: Tensor, amplitude: float, rate: float) -> Tensor:
    """(r - 1)², shape (W,), of the angle d between both hips as a pendulum: r² = (d/A)² + (d'/(Aω))².

    Args:
        angles: right and left hip flexion [rad], (W, 2).
        rates: their velocities [rad/s], (W, 2).
        amplitude: A [rad].
        rate: ω [rad/s].
    """
    swing = torch.stack((angles[:, 0] - angles[:, 1], (rates[:, 0] - rates[:, 1]) / rate), dim=-1) / amplitude
    # The square root has no slope where the legs stand still together.
    radius = torch.sqrt(swing.square().sum(-1) + 1e-4)
    return (radius - 1.0).square()


class LegEnv(Env[AnyLegSettings], Generic[AnyLegSettings]):
    """Observation, in this order, for U muscles and N leg hinges:

    ======= ===================================================================
    1       pelvis height above the ground, minus the standing height [m]
    k       pose of the pelvis, documented in the model's class
    3, 3    its velocity [m/s] and angular velocity [rad/s], world frame
    N, N    hinge angles [rad] and velocities × 0.1 [rad/s]
    U       activations
    U       fibre lengths [optimal lengths]
    U       fibre rates [largest shortening speeds]
    U       muscle forces [peak isometric forces]
    U       last action
    1       target speed [m/s]
    ======= ===================================================================

    All entries carry gradients: lengths and rates have exact ones, forces are computed from them.

    Actions are squashed into excitations by the logistic curve that maps action 0 to the excitation of standing
    (at least `rest_excitation`) and ±1 to 0 and 1, with a slope that is never zero.
    """

    reward_names = (
        *("forward_vel", "progress", "upright", "heading", "height", "alive", "effort", "joint_limit"),
        *("smoothness", "capture", "sway", "symmetry", "stride"),
    )
    stand_height: float
    """Pelvis height of the standing pose [m]."""

    def prepare(self) -> None:
        self.curves = MuscleCurves(self.model, self.device)
        self.action_size = len(self.curves.actuators)
        self.prepare_model()
        held = torch.tensor(self.model.key("stand").ctrl, dtype=torch.float32, device=self.device)
        rest = held[self.curves.actuators].clamp_min(self.config.rest_excitation)
        self._odds = (1.0 - rest) / rest
        self._hinge_qpos = self._index(self.model.jnt_qposadr[self.hinges])
        self._hinge_dofs = self._index(self.model.jnt_dofadr[self.hinges])
        with torch.no_grad():
            stand = torch.tensor(self.model.key("stand").qpos, dtype=torch.float32, device=self.device)[None]
            still = torch.zeros((1, self.model.nv), device=self.device)
            self._upright = self.root(StepState(stand, still, still[:, :0])).up[0]
        self._pendulum_time = math.sqrt(self.stand_height / _GRAVITY)
        ranges = torch.tensor(self.model.jnt_range[self.hinges], dtype=torch.float32, device=self.device)
        self._limits = ranges[:, 0] + _LIMIT_MARGIN, ranges[:, 1] - _LIMIT_MARGIN
        flexions = [self.model.joint(f"hip_flexion_{s}") for s in "rl"]
        self._flexion_dofs = self._index([joint.dofadr[0] for joint in flexions])
        self._flexion_qpos = self._index([joint.qposadr[0] for joint in flexions])
        with torch.no_grad():
            state = self.draw_physics(self.nworld)
            self.obs_size = self.observe(state, torch.zeros((self.nworld, self.action_size), device=self.device)).shape[
                -1
            ]

    @abstractmethod
    def prepare_model(self) -> None:
        """Set `hinges` (joint ids of the legs), `stand_height` and what `root` needs."""

    @abstractmethod
    def root(self, state: StepState) -> Root:
        """The pelvis in the world."""

    @abstractmethod
    def pose_layout(self) -> list[Entry]:
        """Names and units of `Root.pose`."""

    def observation_layout(self) -> list[Entry]:
        muscles, hinges = self.action_names(), [self.model.joint(j).name for j in self.hinges]

        def each(names: list[str], what: str, unit: str = "") -> list[Entry]:
            return entries((f"{name}_{what}" for name in names), unit)

        return [
            Entry("pelvis_height", "m"),
            *self.pose_layout(),
            *entries((f"pelvis_velocity_{axis}" for axis in ("forward", "left", "up")), "m/s"),
            *entries((f"pelvis_angular_velocity_{axis}" for axis in ("forward", "left", "up")), "rad/s"),
            *each(hinges, "angle", "rad"),
            *each(hinges, "rate", "10 rad/s"),
            *each(muscles, "activation"),
            *each(muscles, "fibre_length", "optimal lengths"),
            *each(muscles, "fibre_rate", "largest shortening speeds"),
            *each(muscles, "force", "peak isometric forces"),
            *each(muscles, "last_action"),
            Entry("target_speed", "m/s"),
        ]

    def action_names(self) -> list[str]:
        return [self.model.actuator(int(i)).name for i in self.curves.actuators]

    hinges: list[int]

    def _index(self, values: object) -> Tensor:
        return torch.as_tensor(values, dtype=torch.long, device=self.device)

    def excitation(self, action: Tensor) -> Tensor:
        """Excitations (W, U) in [0, 1] of actions (W, U) in [-1, 1]: s/(s + k(1 - s)), s = (1 + a)/2.

        An action is tanh x, so this is the logistic function of 2x - log k.
        """
        share = 0.5 + 0.5 * action
        return share / (share + self._odds * (1.0 - share))

    def control(self, action: Tensor) -> Tensor:
        return self.excitation(action)

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        root = self.root(state)
        length, rate = self.tendons(state)
        length, rate = self.curves.normalised(length[:, self.curves.tendons], rate[:, self.curves.tendons])
        force = self.curves.force(state.act, length, rate)
        speed = torch.full_like(root.height, self.config.target_speed)
        return torch.cat(
            (
                (root.height - self.stand_height)[:, None],
                root.pose,
                root.velocity,
                root.spin,
                state.qpos[:, self._hinge_qpos],
                _VELOCITY_SCALE * state.qvel[:, self._hinge_dofs],
                state.act,
                length,
                rate,
                force,
                action,
                speed[:, None],
            ),
            dim=-1,
        )

    def reward_terms(self, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
        c, r = self.config, self.config.reward
        root = self.root(state)
        speed = root.velocity[:, 0]
        low, high = self._limits
        angles = state.qpos[:, self._hinge_qpos]
        overshoot = (torch.relu(low - angles) + torch.relu(angles - high)) / _LIMIT_UNIT
        change = action - self.state.action
        # The trunk is half of the body: the centre of mass moves with its lean.
        place = root.place + _TRUNK_LEVER * (root.up[:, :2] - self._upright[:2])
        velocity = root.velocity + _TRUNK_LEVER * torch.linalg.cross(root.spin, root.up)
        place = place + velocity[:, :2] * self._pendulum_time
        distance = place if c.target_speed == 0.0 else place[:, 1:]
        capture = torch.sqrt(1.0 + (distance / r.capture_scale).square().sum(-1)) - 1.0
        flexion_rates = state.qvel[:, self._flexion_dofs]
        flexions = state.qpos[:, self._flexion_qpos]
        terms = (
            r.forward_vel * torch.exp(-((speed - c.target_speed) / r.speed_scale).square()),
            r.progress * speed.clamp_max(c.target_speed),
            r.upright * root.up[:, 2],
            r.heading * root.heading,
            -r.height * torch.relu(self.stand_height - root.height).square(),
            torch.full_like(speed, r.alive),
            -r.effort * state.act.square().mean(-1),
            -r.joint_limit * overshoot.square().sum(-1),
            -r.smoothness * change.square().mean(-1),
            -r.capture * capture,
            -r.sway * root.spin.square().sum(-1),
            -r.symmetry * flexion_rates.sum(-1).square(),
            -r.stride * stride_error(flexions, flexion_rates, r.stride_angle, math.tau * r.cadence / 120.0),
        )
        return torch.stack(terms, dim=-1)

    def fell(self, state: StepState) -> Tensor:
        if not self.config.early_termination:
            return super().fell(state)
        root = self.root(state)
        return (root.height < self.config.min_height * self.stand_height) | (root.up[:, 2] < self.config.min_upright)

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        root = self.root(state)
        return {
            "vx": root.velocity[:, 0],
            "upright": root.up[:, 2],
            "activation": state.act.square().mean(-1),
            "distance": root.place[:, 0],
        }

    def success(self, tail: dict[str, Tensor]) -> Tensor | None:
        """Upright at the end and, when walking, with a mean speed of at least `success_speed` over the episode."""
        standing = tail["upright"][-1] > self.config.min_upright
        if self.config.target_speed == 0.0:
            return standing
        seconds = self.config.episode_length * self.config.control_timestep
        return standing & (tail["distance"][-1] >= self.config.success_speed * seconds)

    @classmethod
    def reference_physics(cls, physics: PhysicsConfig, variant: str | None) -> PhysicsConfig:
        """`physics` with the model's own contacts and limits."""
        return physics.model_copy(update=dict.fromkeys({"cone", "impratio"} | CONTACTS | LIMITS))
