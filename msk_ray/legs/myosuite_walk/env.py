"""MyoSuite's `myoLegWalk-v0` in torch; source: `myosuite/envs/myo/myobase/walk_v0.py` of MyoSuite 2.12.2.

Axes: W worlds, U muscles.
"""

import math
from functools import cached_property

import mujoco
import numpy as np
import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.layout import Entry, each, entries, known, vector
from msk_ray.legs.assistance import Assistance, AssistedEnv, FreeSprings
from msk_ray.legs.clock import fourier
from msk_ray.legs.config import AssistConfig
from msk_ray.legs.feet import Feet
from msk_ray.legs.muscles import MuscleCurves
from msk_ray.legs.myoleg.model import cycle_states
from msk_ray.legs.myosuite_walk.config import TERMS, MyoSuiteWalkSettings
from msk_ray.legs.myosuite_walk.mirror import WalkMirror
from msk_ray.legs.myosuite_walk.model import HINGES, build_myosuite_walk
from msk_ray.legs.reference import people_angles
from msk_ray.step import StepState

SPEED = 1.2
"""Forward speed that is rewarded most [m/s]."""
_PERIOD = 100
"""Env steps of a turn of the phase."""
_SWING = 0.8
"""Largest hip flexion that the phase asks for [rad]."""
_MIN_HEIGHT = 0.8
"""Height of the centre of mass below which an episode ends [m]."""
_MAX_TURN = 0.8
"""Cosine between the x axes of the root and of the world above which an episode ends."""
_RESET_NOISE = 0.02
_AXES = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Forward, left and up. (In MyoSuite's `stand`, the left foot points 16° outwards.)"""
_FEET = ["talus_l", "talus_r"]
_CYCLE_ACTIVATION = 0.05
"""Of every muscle where an episode starts in the gait cycle."""


class MyoSuiteWalk(AssistedEnv[MyoSuiteWalkSettings]):
    """Observation (403 for 80 muscles), in this order:

    ======= ====================================================================
    33      qpos without x and y: height, quaternion of the root, joints [m, rad]
    34      qvel × the control step [m, rad]
    2       minus the mean velocity of the bodies along x and y [m/s]
    4       quaternion of the torso
    2       heights of the left and the right talus [m]
    1       height of the centre of mass [m]
    3, 3    left and right talus from the pelvis, world axes [m]
    1       phase, from 0 to 1 in 100 env steps
    U       lengths of muscles [m]
    U       their velocities [m/s]
    U       their forces, negative where they pull [kN]
    U       activations
    ======= ====================================================================

    All entries but the phase carry gradients. The model walks along −y, so "minus the mean velocity" is positive
    forward; each body counts with its mass, and with the velocity of its point at the centre of mass of the whole.

    The phase lags the count of steps by one, as in MyoSuite: the first two observations of an episode have phase 0, and
    the reward of a step is for the phase of the observation that it ends in.

    With `symmetric`, right and left are exchanged while the phase is in its second half, and it is half a turn less.

    With `cycle`, the number of an episode's task is how many steps its phase is ahead of MyoSuite's.
    """

    Settings = MyoSuiteWalkSettings
    terms = TERMS

    @classmethod
    def build_model(cls, config: MyoSuiteWalkSettings, physics: PhysicsConfig) -> mujoco.MjModel:
        return build_myosuite_walk(config, physics)

    @classmethod
    def reference_settings(cls, config: MyoSuiteWalkSettings) -> MyoSuiteWalkSettings:
        """As for every environment, and with MyoSuite's own starts and switch between activation and deactivation."""
        own = {"smoothing": 0.0, "cycle": 0.0, "assist": AssistConfig()}
        return super().reference_settings(config).model_copy(update=own)

    @classmethod
    def reference_physics(cls, physics: PhysicsConfig, variant: str | None) -> PhysicsConfig:
        """MyoSuite's time step, contacts and solver."""
        return PhysicsConfig()

    def prepare(self) -> None:
        model = self.model
        self.obs_size = model.nq - 2 + model.nv + 2 + 4 + 2 + 1 + 6 + 1 + 4 * model.nu

        self._muscles = MuscleCurves(model, self.device)
        self._bodies = list(range(1, model.nbody))
        self._share = self.tensor(model.body_mass[1:] / model.body_mass[1:].sum())
        starts = {
            "init": ("right_knee_flexed",),
            "none": ("stand",),
            "random": ("right_knee_flexed", "left_knee_flexed"),
        }
        keys = [model.key(name) for name in starts[self.config.reset]]
        self._starts = self.tensor([key.qpos for key in keys]), self.tensor([key.qvel for key in keys])
        self.upright = self.tensor(model.key("stand").qpos[3:7])
        hinges = torch.tensor([model.joint(name).qposadr[0] for name in HINGES], device=self.device)
        self.flexions, self.others = hinges[:2], hinges[2:]
        self.swing = self.tensor([-_SWING, _SWING])
        self._mirror = WalkMirror(model, self.device) if self.config.symmetric else None
        # The phase of people's right leg where MyoSuite's is 0: where the first harmonic of their hip is largest.
        even, odd = fourier(people_angles()[0])[:, 1]
        self.hip_lag = math.atan2(odd, even) / math.tau
        self.assistance = Assistance(self.config.assist, self.config.control_timestep, self.device)
        self._springs = FreeSprings(model, _AXES, self.device)
        self._starts_in_cycle = self.config.cycle > 0.0 and self.config.stochastic_reset
        if self._starts_in_cycle:
            self._cycle = self._cycle_starts()

    @cached_property
    def standing_center(self) -> float:
        """Height of the centre of mass in standing [m]."""
        data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, data, self.model.key("stand").id)
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        return float(data.subtree_com[0, 2])

    @cached_property
    def feet(self) -> Feet:
        """The heels and toes."""
        return Feet(self.model, float(self.model.key("stand").qpos[2]), self.device)

    def _cycle_starts(self) -> tuple[Tensor, Tensor, Tensor]:
        """qpos (N, nq), qvel (N, nv) and steps ahead (N, 1) of starts over the gait cycle."""
        qpos, qvel = cycle_states(self.model)
        qvel /= _PERIOD * self.config.control_timestep
        qvel[:, :3] += SPEED * _AXES[0]
        ahead = np.arange(len(qpos)) / len(qpos) - self.hip_lag
        return self.tensor(qpos), self.tensor(qvel), self.tensor(np.round(_PERIOD * (ahead % 1.0))[:, None])

    def draw_start(self, count: int) -> tuple[StepState, Tensor]:
        start, task = super().draw_start(count)
        if not self._starts_in_cycle:
            return start, task
        qpos, qvel, ahead = self._cycle
        drawn = 0.5 + 0.5 * self.uniform(count, 2)
        at = (drawn[:, 1] * len(qpos)).long()
        elsewhere = drawn[:, :1] < self.config.cycle
        act = torch.full_like(start.act, _CYCLE_ACTIVATION)
        cycle = StepState(qpos[at], qvel[at], act)
        mixed = StepState(*(torch.where(elsewhere, c, s) for c, s in zip(cycle, start, strict=True)))
        return mixed, torch.where(elsewhere, ahead[at], 0.0)

    def applied_force(self, state: StepState) -> Tensor | None:
        return self.assistance.share * self._springs.force(state) if self.config.assist.epochs else None

    def draw_physics(self, count: int) -> StepState:
        starts, speeds = self._starts
        choice = torch.zeros(count, dtype=torch.long, device=self.device)
        noise = torch.zeros((count, self.model.nq), device=self.device)
        if self.config.reset == "random" and self.config.stochastic_reset:
            choice = (self.uniform(count) >= 0.0).long()
            drawn = torch.randn(noise.shape, generator=self.generator, device=self.generator.device)
            noise = _RESET_NOISE * drawn.to(self.device)
            noise[:, 2] = 0.0
        # As in MyoSuite, the quaternion has noise too and is not normalised before the first step.
        act = torch.zeros((count, self.model.na), device=self.device)
        return StepState(starts[choice] + noise, speeds[choice], act)

    def control(self, action: Tensor) -> Tensor:
        """Excitations 1/(1 + exp(−5 (a − ½))): 0.08 at action 0, and 0.0006 to 0.92 over [−1, 1]."""
        if self._mirror is not None:
            action = self._mirror.action(self.phase(self._observed_steps()) >= 0.5, action)
        return torch.sigmoid(5.0 * (action - 0.5))

    def _observed_steps(self) -> Tensor:
        """Steps (W,) whose phase the current state is observed with."""
        return (self.state.age - 1).clamp_min(0)

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        q, v = state.qpos, state.qvel
        frames = self.frames(state)
        feet = frames.position(_FEET)
        length, rate = self.tendons(state)
        length, rate = length[:, self._muscles.tendons], rate[:, self._muscles.tendons]
        pull = self._muscles.force(state.act, *self._muscles.normalised(length, rate))
        obs = torch.cat(
            (
                q[:, 2:],
                self.config.control_timestep * v,
                self.velocity(state),
                frames.orientation("torso"),
                feet[..., 2],
                frames.center_of_mass()[:, 2:],
                (feet - frames.position("pelvis")[:, None]).flatten(1),
                self.phase(self._observed_steps())[:, None],
                length,
                rate,
                -1e-3 * self._muscles.peak * pull,
                state.act,
            ),
            dim=-1,
        )
        return obs if self._mirror is None else self._mirror.observation(obs)

    def phase(self, steps: Tensor) -> Tensor:
        """Phase [turns] after so many steps of MyoSuite's, (W,)."""
        if self._starts_in_cycle:
            steps = steps + self.task_numbers(self.state.numbers)[:, 0]
        return torch.remainder(steps, _PERIOD) / _PERIOD

    def velocity(self, state: StepState) -> Tensor:
        """Minus the mean of `cvel` along x and y, weighted with mass [m/s], (W, 2)."""
        frames = self.frames(state)
        arms = frames.center_of_mass()[:, None] - frames.position(self._bodies)
        spins = frames.angular_velocity(self._bodies)
        at_center = frames.velocity(self._bodies) + torch.linalg.cross(spins, arms)
        return -torch.einsum("b,wbk->wk", self._share, at_center)[:, :2]

    def observation_layout(self) -> list[Entry]:
        model = self.model
        joints, muscles = [model.joint(j).name for j in range(1, model.njnt)], self.action_names()
        assert muscles is not None  # the model's actuators are its muscles

        root = [*vector("root_velocity", "m/s × step"), *vector("root_angular_velocity", "rad/s × step")]
        return [
            Entry("root_height", "m"),
            *entries(f"root_quaternion_{axis}" for axis in "wxyz"),
            *each(joints, "position", "m or rad"),
            *root,
            *each(joints, "rate", "m/s or rad/s × step"),
            *entries(("velocity_minus_x", "velocity_forward"), "m/s"),
            *entries(f"torso_quaternion_{axis}" for axis in "wxyz"),
            *each(_FEET, "height", "m"),
            Entry("center_of_mass_height", "m"),
            *(entry for foot in _FEET for entry in vector(f"{foot}_from_pelvis", "m")),
            *known(entries(("phase",), "turns")),
            *each(muscles, "length", "m"),
            *each(muscles, "velocity", "m/s"),
            *each(muscles, "force", "kN"),
            *each(muscles, "activation"),
        ]

    def fell(self, state: StepState) -> Tensor:
        low = self.frames(state).center_of_mass()[:, 2] < _MIN_HEIGHT
        y, z = state.qpos[:, 5], state.qpos[:, 6]
        return low | ((1.0 - 2.0 * (y.square() + z.square())).abs() > _MAX_TURN)

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        """`vx` is the velocity forward [m/s]."""
        return {"vx": self.velocity(state)[:, 1], "activation": state.act.square().mean(-1)}
