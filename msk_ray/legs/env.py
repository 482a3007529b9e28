"""The shared part of muscle-driven legs: excitation, observation of muscles, reward, falls and outcomes.

Axes: W worlds, U muscles, N hinges of the legs.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import ClassVar, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.config.physics import CONTACTS
from msk_ray.envs.layout import Entry, each, entries, known
from msk_ray.errors import ConfigError
from msk_ray.legs.assistance import Assistance, AssistedEnv
from msk_ray.legs.config import OUT_OF_PLANE, TERMS, AssistConfig, LegSettings
from msk_ray.legs.feet import Feet, FootMotion
from msk_ray.legs.gait.body import analyse, world_axes
from msk_ray.legs.gait.measure import measure, summary
from msk_ray.legs.metabolic import muscle_masses, total_power
from msk_ray.legs.mirror import Mirror, check_mirrored, leg_mirrors
from msk_ray.legs.muscles import MuscleCurves, columns
from msk_ray.legs.reference import Reference
from msk_ray.legs.regular_pushes import pushed
from msk_ray.legs.root import Root
from msk_ray.step import StepState

AnyLegSettings = TypeVar("AnyLegSettings", bound=LegSettings)

_GRAVITY = 9.81
_LIMIT_MARGIN = 0.05
"""Distance from a joint limit at which the penalty starts [rad]."""
_LOWEST, _MOST_TILTED = 0.65, 0.5
"""Share of the standing height of the pelvis, and cosine between the trunk's up axis and +z, below which it has
fallen."""
_REST_EXCITATION = 0.02
"""Smallest excitation of a muscle at action 0, unless the standing keyframe has a larger one."""
_SUCCESS_SPEED = 0.8
"""Mean speed over the episode from which walking counts as a success [m/s]."""
_VELOCITY_SCALE = 0.1
"""Scale of joint velocities in the observation [s/rad]."""


class LegEnv(AssistedEnv[AnyLegSettings], Generic[AnyLegSettings]):
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
    2       with `clock`: cos and sin of the right leg's phase
    ======= ===================================================================

    All entries carry gradients: lengths and rates have exact ones, forces are computed from them.

    Actions are squashed into excitations by the logistic curve that maps action 0 to the excitation of standing
    (at least `_REST_EXCITATION`) and ±1 to 0 and 1, with a slope that is never zero.

    With `clock` or `speed_range`, the numbers of an episode's task are its target speed [m/s] and the phase [turns] it
    starts with. With `symmetric`, observations and actions are those of the mirrored body while the phase is in its
    second half; the phase that is observed is then that of the left leg.
    """

    terms = TERMS
    pose_signs: ClassVar[tuple[float, ...]]
    """Signs of the mirror image of `Root.pose`."""
    stand_height: float
    """Pelvis height of the standing pose [m]."""

    def prepare(self) -> None:
        self.curves = MuscleCurves(self.model, self.device)
        self.action_size = len(self.curves.actuators)
        self.prepare_model()
        held = self.tensor(self.model.key("stand").ctrl)
        rest = held[self.curves.actuators].clamp_min(_REST_EXCITATION)
        self._odds = (1.0 - rest) / rest
        self.hinge_qpos = columns(self.model.jnt_qposadr[self.hinges], self.device)
        self._hinge_dofs = columns(self.model.jnt_dofadr[self.hinges], self.device)
        with torch.no_grad():
            stand = self.tensor(self.model.key("stand").qpos)[None]
            still = torch.zeros((1, self.model.nv), device=self.device)
            self.standing_up = self.root(StepState(stand, still, still[:, :0])).up[0]
            # The first three dofs move the pelvis without turning it: what they are for a speed forward, and left.
            units = torch.eye(3, self.model.nv, device=self.device)
            self._slides = self.root(StepState(stand.repeat(3, 1), units, units[:, :0])).velocity.T[:2]
        self.pendulum_time = math.sqrt(self.stand_height / _GRAVITY)
        ranges = self.tensor(self.model.jnt_range[self.hinges])
        self.hinge_limits = ranges[:, 0] + _LIMIT_MARGIN, ranges[:, 1] - _LIMIT_MARGIN
        flexions = [self.model.joint(f"hip_flexion_{s}") for s in "rl"]
        self._flexion_dofs = columns([joint.dofadr[0] for joint in flexions], self.device)
        self.flexion_qpos = columns([joint.qposadr[0] for joint in flexions], self.device)
        self._tasked = self.config.clock or self.config.speed_range is not None
        self.assistance = Assistance(self.config.assist, self.config.control_timestep, self.device)
        self.kept_worlds = self.config.gait_worlds
        self.mass = float(self.model.body_subtreemass[0])
        self._masses = muscle_masses(self.curves.peak, self.curves.optimum)
        if self._tasked:
            self.reference = Reference(self.model, self.device)
            self.track_qpos = columns(self.model.jnt_qposadr[self.reference.joints], self.device)
            self.track_dofs = columns(self.model.jnt_dofadr[self.reference.joints], self.device)
        self._mirror: Mirror | None = None
        self._mirror_action: Mirror | None = None
        if self.config.symmetric:
            self._prepare_mirror()
        with torch.no_grad():
            state, task = self.draw_start(self.nworld)
            still = torch.zeros((self.nworld, self.action_size), device=self.device)
            self.obs_size = self._observed(state, still, task, torch.zeros_like(state.qpos[:, 0])).shape[-1]

    def _prepare_mirror(self) -> None:
        check_mirrored(self.model, self.hinges, world_axes(self.model))
        hinges = [self.model.joint(j).name for j in self.hinges]
        self._mirror, self._mirror_action = leg_mirrors(self.pose_signs, hinges, self.action_names(), self.device)

    @abstractmethod
    def prepare_model(self) -> None:
        """Set `hinges` (joint ids of the legs), `stand_height` and what `measure_root` needs."""

    @abstractmethod
    def measure_root(self, state: StepState) -> Root:
        """The pelvis in the world, as `root` gives it."""

    def root(self, state: StepState) -> Root:
        """The pelvis in the world, computed once per state."""
        return self.measurements.once("root", state, lambda: self.measure_root(state))

    @abstractmethod
    def people_poses(self) -> NDArray[np.float64]:
        """qpos (N, nq) of people at equal distances of the gait cycle, from the right foot's strike on."""

    @abstractmethod
    def pose_layout(self) -> list[Entry]:
        """Names and units of `Root.pose`."""

    def observation_layout(self) -> list[Entry]:
        muscles, hinges = self.action_names(), [self.model.joint(j).name for j in self.hinges]

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
            *known(each(muscles, "last_action")),
            *known(entries(("target_speed",), "m/s")),
            *known(entries(f"clock_{part}" for part in (("cos", "sin") if self.config.clock else ()))),
        ]

    def action_names(self) -> list[str]:
        return [self.model.actuator(int(i)).name for i in self.curves.actuators]

    hinges: list[int]

    def excitation(self, action: Tensor) -> Tensor:
        """Excitations (W, U) in [0, 1] of actions (W, U) in [-1, 1]: s/(s + k(1 - s)), s = (1 + a)/2.

        An action is tanh x, so this is the logistic function of 2x - log k.
        """
        share = 0.5 + 0.5 * action
        return share / (share + self._odds * (1.0 - share))

    def control(self, action: Tensor) -> Tensor:
        return self.excitation(self.own_sides(action, self.state.age))

    def disturbed(self, state: StepState) -> StepState:
        return pushed(state, self.state.age, self.config.push, self.config.control_timestep, self._slides)

    def draw_start(self, count: int) -> tuple[StepState, Tensor]:
        if not self._tasked:
            return super().draw_start(count)
        speed = torch.full((count,), self.config.target_speed, device=self.device)
        if self.config.speed_range is not None:
            low, high = self.config.speed_range
            speed = low + (high - low) * (0.5 + 0.5 * self.uniform(count, 1)[:, 0])
        phase = 0.5 + 0.5 * self.uniform(count, 1)[:, 0]
        return self.draw_phase(phase, speed), torch.stack((speed, phase), dim=-1)

    def draw_phase(self, phase: Tensor, speed: Tensor) -> StepState:
        """Initial states of episodes that start at these phases [turns] and target speeds [m/s], each (N,)."""
        return self.draw_physics(len(phase))

    def phase(self, numbers: Tensor, age: Tensor) -> Tensor:
        """Phase of the right leg [turns] after `age` env steps, (W,), for `EnvState.numbers`."""
        return self._phase(self.task_numbers(numbers), age)

    def _phase(self, task: Tensor, age: Tensor) -> Tensor:
        speed, start = task[:, 0], task[:, 1]
        return start + age * self.config.control_timestep * self.reference.pace.strides_per_second(speed)

    def _exchanged(self, task: Tensor, age: Tensor) -> Tensor:
        """Worlds (W,) bool whose sides the policy sees exchanged."""
        return torch.remainder(self._phase(task, age), 1.0) >= 0.5

    def own_sides(self, action: Tensor, age: Tensor) -> Tensor:
        """Actions (W, A), which were chosen at `age`, for the body as it is."""
        if self._mirror_action is None:
            return action
        return self._mirror_action.where(self._exchanged(self.task_numbers(self.state.numbers), age), action)

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        age = self.state.age
        # The action was chosen one step before.
        return self._observed(state, self.own_sides(action, age - 1), self.task_numbers(self.state.numbers), age)

    def _observed(self, state: StepState, action: Tensor, task: Tensor, age: Tensor) -> Tensor:
        """Observation (W, O) of a state at an age, after an action for the body as it is."""
        root = self.root(state)
        length, rate = self.tendons(state)
        length, rate = self.curves.normalised(length[:, self.curves.tendons], rate[:, self.curves.tendons])
        force = self.curves.force(state.act, length, rate)
        speed = task[:, 0] if self._tasked else torch.full_like(root.height, self.config.target_speed)
        clock = []
        if self.config.clock:
            angle = math.tau * self._phase(task, age)
            clock = [torch.stack((torch.cos(angle), torch.sin(angle)), dim=-1).to(root.height.dtype)]
        obs = torch.cat(
            (
                (root.height - self.stand_height)[:, None],
                root.pose,
                root.velocity,
                root.spin,
                state.qpos[:, self.hinge_qpos],
                _VELOCITY_SCALE * state.qvel[:, self._hinge_dofs],
                state.act,
                length,
                rate,
                force,
                action,
                speed[:, None],
                *clock,
            ),
            dim=-1,
        )
        return obs if self._mirror is None else self._mirror.where(self._exchanged(task, age), obs)

    @property
    def target(self) -> float | Tensor:
        """Target speed [m/s], (W,) where the episodes of worlds may have different ones.

        A number where it is the same for all, so that nothing is computed for each world.
        """
        return self.task_speed() if self._tasked else self.config.target_speed

    def task_speed(self) -> Tensor:
        """Target speed of each world's episode [m/s], (W,)."""
        return self.task_numbers(self.state.numbers)[:, 0]

    def speed(self, state: StepState) -> Tensor:
        """Forward speed [m/s], (W,)."""
        return self.measurements.once("speed", state, lambda: self.root(state).velocity.unbind(-1)[0])

    def flexion_rates(self, state: StepState) -> Tensor:
        """Rates of the right and the left hip's flexion [rad/s], (W, 2)."""
        return self.measurements.once("flexion_rates", state, lambda: state.qvel[:, self._flexion_dofs])

    def metabolic_power(self, state: StepState, action: Tensor) -> Tensor:
        """Metabolic power of all muscles [W], (W,), without that of rest, after actions (W, A)."""
        excitation = self.excitation(self.own_sides(action, self.state.age))
        return total_power(self.curves, self._masses, excitation, state.act, *self.tendons(state))

    @cached_property
    def feet(self) -> Feet:
        """The heels and toes."""
        return Feet(self.model, self.stand_height, self.device)

    def foot_motion(self, state: StepState) -> FootMotion:
        """Heights and velocities of heels and toes."""
        return self.feet.motion(self.frames(state), self.root(state).height)

    def leg_phase(self) -> Tensor:
        """Phase of the right leg [turns] in the state that a step leads to, (W,)."""
        return self.phase(self.state.numbers, self.state.age + 1)

    @cached_property
    def sideways_qpos(self) -> slice | Tensor:
        """Places in qpos of joints that turn legs out of the plane they walk in."""
        sideways = [j for j in self.hinges if self.model.joint(j).name.rsplit("_", 1)[0] in OUT_OF_PLANE]
        if not sideways:
            raise ConfigError(
                f"env.reward.out_of_plane: the model has none of the joints {', '.join(OUT_OF_PLANE)} (with _r and "
                "_l); leave it out"
            )
        return columns(self.model.jnt_qposadr[sideways], self.device)

    def fell(self, state: StepState) -> Tensor:
        if not self.config.early_termination:
            return super().fell(state)
        root = self.root(state)
        return (root.height < _LOWEST * self.stand_height) | (root.up[:, 2] < _MOST_TILTED)

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        root = self.root(state)
        return {
            "vx": root.velocity[:, 0],
            "upright": root.up[:, 2],
            "activation": state.act.square().mean(-1),
            "distance": root.place[:, 0],
        }

    def trajectory_figures(self, trajectories: Sequence[StepState]) -> dict[str, float]:
        """Figures of the gait at control steps, so that foot strikes are seen up to one of them late.

        `msk-ray gait` repeats the physics substeps between them, which would cost time in every evaluation.
        """
        found = []
        for states in trajectories:
            qpos, qvel, act = (part.double().numpy() for part in states)
            found.append(analyse(self.model, qpos, qvel, act, self.config.control_timestep))
        return summary(measure(found, []))

    def success(self, tail: dict[str, Tensor]) -> Tensor | None:
        """Upright at the end and, when walking, with a mean speed of at least `_SUCCESS_SPEED` over the episode."""
        standing = tail["upright"][-1] > _MOST_TILTED
        if self.config.target_speed == 0.0:
            return standing
        seconds = self.config.episode_length * self.config.control_timestep
        return standing & (tail["distance"][-1] >= _SUCCESS_SPEED * seconds)

    @classmethod
    def reference_settings(cls, config: AnyLegSettings) -> AnyLegSettings:
        """The reference reward at `target_speed`, without assistance."""
        return super().reference_settings(config).model_copy(update={"speed_range": None, "assist": AssistConfig()})

    @classmethod
    def reference_physics(cls, physics: PhysicsConfig, variant: str | None) -> PhysicsConfig:
        """`physics` with the model's own contacts."""
        return physics.model_copy(update=dict.fromkeys({"cone"} | CONTACTS))
