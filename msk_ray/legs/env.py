"""The shared part of muscle-driven legs: excitation, observation of muscles, reward, falls and outcomes.

Axes: W worlds, U muscles, N hinges of the legs.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.config.physics import CONTACTS, LIMITS
from msk_ray.envs.layout import Entry, entries
from msk_ray.envs.limits import squared_overshoot
from msk_ray.errors import ConfigError
from msk_ray.legs import terms as costs
from msk_ray.legs.assistance import Assistance, AssistedEnv
from msk_ray.legs.config import FURTHER, OUT_OF_PLANE, AssistConfig, LegReward, LegSettings
from msk_ray.legs.feet import Feet, FootMotion
from msk_ray.legs.gait.body import analyse, world_axes
from msk_ray.legs.gait.measure import measure, summary
from msk_ray.legs.metabolic import muscle_masses, total_power
from msk_ray.legs.mirror import Mirror, check_mirrored, leg_mirrors
from msk_ray.legs.muscles import MuscleCurves, columns
from msk_ray.legs.push import pushed
from msk_ray.legs.reference import Reference
from msk_ray.legs.root import Root
from msk_ray.step import StepState

AnyLegSettings = TypeVar("AnyLegSettings", bound=LegSettings)

_GRAVITY = 9.81
_TRUNK_LEVER = 0.18
"""How far the centre of mass moves with the trunk's up axis [m]: 34 kg of 75 kg, 0.4 m above the pelvis."""
_LIMIT_MARGIN = 0.05
"""Distance from a joint limit at which the penalty starts [rad]."""
_HEAD_LEVER = 0.65
"""Height of the head above the pelvis [m]."""
_LEG_LENGTH = 0.9
"""Leg whose steps have the length of people's [m]."""
_GAINS = frozenset(("forward_vel", "progress", "upright", "heading", "alive"))
"""The terms of the reward that are no costs."""
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
    (at least `rest_excitation`) and ±1 to 0 and 1, with a slope that is never zero.

    With `clock` or `speed_range`, the numbers of an episode's task are its target speed [m/s] and the phase [turns] it
    starts with. With `symmetric`, observations and actions are those of the mirrored body while the phase is in its
    second half; the phase that is observed is then that of the left leg.
    """

    reward_names: tuple[str, ...] = (
        *("forward_vel", "progress", "upright", "heading", "height", "alive", "effort", "joint_limit"),
        *("smoothness", "capture", "sway", "symmetry", "stride"),
    )
    without_gradient = ("alive",)
    pose_signs: ClassVar[tuple[float, ...]]
    """Signs of the mirror image of `Root.pose`."""
    stand_height: float
    """Pelvis height of the standing pose [m]."""

    def prepare(self) -> None:
        self.curves = MuscleCurves(self.model, self.device)
        self.action_size = len(self.curves.actuators)
        self.prepare_model()
        held = torch.tensor(self.model.key("stand").ctrl, dtype=torch.float32, device=self.device)
        rest = held[self.curves.actuators].clamp_min(self.config.rest_excitation)
        self._odds = (1.0 - rest) / rest
        self._hinge_qpos = columns(self.model.jnt_qposadr[self.hinges], self.device)
        self._hinge_dofs = columns(self.model.jnt_dofadr[self.hinges], self.device)
        with torch.no_grad():
            stand = torch.tensor(self.model.key("stand").qpos, dtype=torch.float32, device=self.device)[None]
            still = torch.zeros((1, self.model.nv), device=self.device)
            self._upright = self.root(StepState(stand, still, still[:, :0])).up[0]
            # The first three dofs move the pelvis without turning it: what they are for a speed forward, and left.
            units = torch.eye(3, self.model.nv, device=self.device)
            self._slides = self.root(StepState(stand.repeat(3, 1), units, units[:, :0])).velocity.T[:2]
        self._pendulum_time = math.sqrt(self.stand_height / _GRAVITY)
        ranges = torch.tensor(self.model.jnt_range[self.hinges], dtype=torch.float32, device=self.device)
        self._limits = ranges[:, 0] + _LIMIT_MARGIN, ranges[:, 1] - _LIMIT_MARGIN
        flexions = [self.model.joint(f"hip_flexion_{s}") for s in "rl"]
        self._flexion_dofs = columns([joint.dofadr[0] for joint in flexions], self.device)
        self._flexion_qpos = columns([joint.qposadr[0] for joint in flexions], self.device)
        self._tasked = self.config.clock or self.config.speed_range is not None
        self._tracking_share = torch.tensor(self.config.tracking.at(0), device=self.device)
        self.assistance = Assistance(self.config.assist, self.config.control_timestep, self.device)
        self.recorded_worlds = self.config.gait_worlds
        self._prepare_terms()
        self._mirror: Mirror | None = None
        self._mirror_action: Mirror | None = None
        if self.config.symmetric:
            self._prepare_mirror()
        with torch.no_grad():
            state, task = self.draw_start(self.nworld)
            still = torch.zeros((self.nworld, self.action_size), device=self.device)
            self.obs_size = self._observed(state, still, task, torch.zeros_like(state.qpos[:, 0])).shape[-1]

    def _prepare_terms(self) -> None:
        """The terms whose weight is not zero, which come after those that are always there, and what they need."""
        self._further = [name for name in FURTHER if getattr(self.config.reward, name) > 0.0]
        common = LegEnv.reward_names
        self.reward_names = (*common, *self._further, *type(self).reward_names[len(common) :])
        self._weights = self.weights(self.config.reward)
        self._mass = float(self.model.body_subtreemass[0])
        self._masses = muscle_masses(self.curves.peak, self.curves.optimum)
        if self._tasked:
            self.reference = Reference(self.model, self.device)
            self._track_qpos = columns(self.model.jnt_qposadr[self.reference.joints], self.device)
            self._track_dofs = columns(self.model.jnt_dofadr[self.reference.joints], self.device)
        if "out_of_plane" in self._further:
            sideways = [j for j in self.hinges if self.model.joint(j).name.rsplit("_", 1)[0] in OUT_OF_PLANE]
            if not sideways:
                raise ConfigError(
                    f"env.reward.out_of_plane: the model has none of the joints {', '.join(OUT_OF_PLANE)} (with _r and "
                    "_l); leave it out"
                )
            self._sideways_qpos = columns(self.model.jnt_qposadr[sideways], self.device)
        if {"impact", "footfall", "landing", "clearance", "toes"} & set(self._further):
            self._feet = Feet(self.model, self.stand_height, self.device)

    def weights(self, reward: LegReward) -> Tensor:
        """Weights of the terms, negative for costs."""
        signed = [getattr(reward, n) * (1.0 if n in _GAINS else -1.0) for n in (*LegEnv.reward_names, *self._further)]
        return torch.tensor(signed, device=self.device)

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
        found: Root = self._once("root", state, lambda: self.measure_root(state))
        return found

    @abstractmethod
    def people_poses(self) -> NDArray[np.float64]:
        """qpos (N, nq) of people at equal distances of the gait cycle, from the right foot's strike on."""

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
            *entries(f"clock_{part}" for part in (("cos", "sin") if self.config.clock else ())),
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
        return self.excitation(self._own_sides(action, self.state.age))

    def begin_epoch(self, epoch: int) -> None:
        super().begin_epoch(epoch)
        self._tracking_share.fill_(self.config.tracking.at(epoch))

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

    def _own_sides(self, action: Tensor, age: Tensor) -> Tensor:
        """Actions (W, A), which were chosen at `age`, for the body as it is."""
        if self._mirror_action is None:
            return action
        return self._mirror_action.where(self._exchanged(self.task_numbers(self.state.numbers), age), action)

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        age = self.state.age
        # The action was chosen one step before.
        return self._observed(state, self._own_sides(action, age - 1), self.task_numbers(self.state.numbers), age)

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
                state.qpos[:, self._hinge_qpos],
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

    def reward_terms(self, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
        c, r = self.config, self.config.reward
        # A number where it is the same for all, so that nothing is computed for each world.
        target: float | Tensor = c.target_speed
        amplitude: float | Tensor = r.stride_angle
        turn: float | Tensor = math.tau * r.cadence / 120.0
        if self._tasked:
            target = self.task_numbers(self.state.numbers)[:, 0]
        if c.clock and isinstance(target, Tensor):
            pace = self.reference.pace
            amplitude = pace.hip_swing(target, _LEG_LENGTH)[:, None]
            turn = math.tau * pace.strides_per_second(target)
        root = self.root(state)
        (speed, _, _), (_, _, upright) = root.velocity.unbind(-1), root.up.unbind(-1)
        angles = state.qpos[:, self._hinge_qpos]
        change = self._own_sides(action, self.state.age) - self._own_sides(self.state.action, self.state.age - 1)
        # The trunk is half of the body: the centre of mass moves with its lean.
        velocity = root.velocity + _TRUNK_LEVER * torch.linalg.cross(root.spin, root.up)
        place = root.place + (velocity * self._pendulum_time + _TRUNK_LEVER * (root.up - self._upright))[:, :2]
        distance = place if c.target_speed == 0.0 else place[:, 1:]
        capture = torch.sqrt(1.0 + (distance / r.capture_scale).square().sum(-1)) - 1.0
        flexion_rates = state.qvel[:, self._flexion_dofs]
        flexions = state.qpos[:, self._flexion_qpos]
        terms = (
            torch.exp(-((speed - target) / r.speed_scale).square()),
            torch.minimum(speed, target) if isinstance(target, Tensor) else speed.clamp_max(target),
            upright,
            root.heading,
            torch.relu(self.stand_height - root.height).square(),
            torch.ones_like(speed),
            state.act.square().mean(-1),
            squared_overshoot(angles, *self._limits),
            change.square().mean(-1),
            capture,
            root.spin.square().sum(-1),
            flexion_rates.sum(-1).square(),
            costs.stride_error(flexions, flexion_rates, amplitude, turn),
            *(self._further_cost(name, state, action) for name in self._further),
        )
        return torch.stack(terms, dim=-1) * self._weights

    def _further_cost(self, name: str, state: StepState, action: Tensor) -> Tensor:
        """One of the terms of `FURTHER`, without its weight, (W,)."""
        match name:
            case "metabolic":
                return self.metabolic_power(state, action) / self._mass
            case "fatigue":
                return state.act.pow(3).mean(-1)
            case "head":
                return self._head_speed(state)[:, 1:].square().sum(-1)
            case "impact":
                feet = self._foot_motion(state)
                return costs.impact(feet.height, feet.rise)
            case "footfall":
                return self._foot_motion(state).sliding(self._leg_phases()[0])
            case "landing":
                return self._foot_motion(state).hovering(self._leg_phases()[0])
            case "clearance":
                wanted = self.config.reward.clearance_height
                return self._foot_motion(state).dragging(self._leg_phases()[0], wanted)
            case "toes":
                return self._lifted_toes(state)
            case "out_of_plane":
                return costs.out_of_plane(state.qpos[:, self._sideways_qpos])
            case "vault":
                speed = self.task_numbers(self.state.numbers)[:, 0]
                rise = self.reference.pace.vault(self._leg_phases()[0], speed)
                return costs.vaulting(self.root(state).velocity[:, 2], rise)
            case _:
                return self._tracking(state)[("track", "track_rate").index(name)]

    def metabolic_power(self, state: StepState, action: Tensor) -> Tensor:
        """Metabolic power of all muscles [W], (W,), without that of rest, after actions (W, A)."""
        excitation = self.excitation(self._own_sides(action, self.state.age))
        return total_power(self.curves, self._masses, excitation, state.act, *self.tendons(state))

    def _head_speed(self, state: StepState) -> Tensor:
        """Velocity of the head [m/s], (W, 3): forward, left, up."""
        root = self.root(state)
        return root.velocity + _HEAD_LEVER * torch.linalg.cross(root.spin, root.up)

    def _foot_motion(self, state: StepState) -> FootMotion:
        return self._feet.motion(self.frames(state), self.root(state).height)

    def _leg_phases(self) -> tuple[Tensor, Tensor]:
        """Phases [turns] of the right and the left leg in the state that a step leads to, each (W,)."""
        phase = self.phase(self.state.numbers, self.state.age + 1)
        return phase, phase + 0.5

    def _lifted_toes(self, state: StepState) -> Tensor:
        (right, left), (slope, bend) = self._leg_phases(), self._feet.toes(self.frames(state))
        return costs.lifted_toes(right, slope[:, 0], bend[:, 0]) + costs.lifted_toes(left, slope[:, 1], bend[:, 1])

    def _tracking(self, state: StepState) -> tuple[Tensor, Tensor]:
        """Costs (W,) of the distance from people's joint angles and of that from their rates."""
        r = self.config.reward
        speed = self.task_numbers(self.state.numbers)[:, 0]
        angles, rates = self.reference(self._leg_phases()[0], speed)
        apart = costs.deviation(state.qpos[:, self._track_qpos], angles, r.track_scale)
        rates_apart = costs.deviation(state.qvel[:, self._track_dofs], rates, r.track_rate_scale)
        return self._tracking_share * apart, self._tracking_share * rates_apart

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
        """Upright at the end and, when walking, with a mean speed of at least `success_speed` over the episode."""
        standing = tail["upright"][-1] > self.config.min_upright
        if self.config.target_speed == 0.0:
            return standing
        seconds = self.config.episode_length * self.config.control_timestep
        return standing & (tail["distance"][-1] >= self.config.success_speed * seconds)

    @classmethod
    def reference_settings(cls, config: AnyLegSettings) -> AnyLegSettings:
        """The reference reward at `target_speed`, without assistance."""
        return super().reference_settings(config).model_copy(update={"speed_range": None, "assist": AssistConfig()})

    @classmethod
    def reference_physics(cls, physics: PhysicsConfig, variant: str | None) -> PhysicsConfig:
        """`physics` with the model's own contacts and limits."""
        return physics.model_copy(update=dict.fromkeys({"cone", "impratio"} | CONTACTS | LIMITS))
