"""Legged robots that follow commands for their velocity. Source: `mjlab/tasks/velocity` of mjlab 1.6.0.

Axes: W worlds, J joints except the free one, F feet.
"""

import math
from collections.abc import Mapping
from typing import Generic, TypeVar

import torch
from torch import Tensor

from msk_ray.envs.layout import Entry, each, entries, known, vector
from msk_ray.envs.memory import Memory
from msk_ray.errors import ConfigError
from msk_ray.robots.config import (
    G1_TERMS,
    GO1_TERMS,
    VELOCITY,
    G1VelocitySettings,
    Go1VelocitySettings,
    VelocitySettings,
)
from msk_ray.robots.mjcf_check import GROUND, missing, missing_parts
from msk_ray.robots.robot import by_joint
from msk_ray.robots.servos import ServoEnv
from msk_ray.robots.unitree import G1, GO1
from msk_ray.step import StepState
from msk_ray.step.autograd.contact_state import AirTime, Contact
from msk_ray.step.autograd.tangent import quat_conjugate, quat_multiply, quat_rotate, quat_yaw

AnyVelocitySettings = TypeVar("AnyVelocitySettings", bound=VelocitySettings)

_FALLEN = math.radians(70.0)
"""Tilt of the base at which an episode ends [rad]."""
_START_NOISE = torch.tensor([0.5, 0.5, 0.02, math.pi])
"""Largest noise of the initial position [m] and yaw [rad]."""
_START_HEIGHT = 0.03
"""Mean height of initial states above the keyframe [m]."""
_WALKING, _RUNNING = 0.05, 1.5
"""Commanded speeds, in m/s plus rad/s, from which the robot should walk and run."""
_SHARES = (0.1, 0.2, 0.3)
"""Shares of commands to stand, to go straight ahead, and to turn to a heading."""
_SLOWEST_AHEAD = 0.3
"""Smallest command to go straight ahead [m/s]."""
_HEADING_GAIN = 0.5
"""Commanded yaw rate for an error in heading of 1 rad [1/s]."""


_SENSORS = {"imu_lin_vel": "velocimeter", "imu_ang_vel": "gyro", "root_angmom": "subtreeangmom"}
"""Types of the sensors that a model needs: the first two for the observation, the last for `angular_momentum`."""


class VelocityEnv(ServoEnv[AnyVelocitySettings], Generic[AnyVelocitySettings]):
    """A robot on flat ground whose base is to move as commanded.

    A subclass has `mjcf`, `robot` and `terms` from `msk_ray.robots.terms`. The MJCF has one free joint, which comes
    first, J hinges with a position servo each, a keyframe with the default pose, a body `terrain`, and the sensors
    `imu_lin_vel`, `imu_ang_vel` and, for the term `angular_momentum`, `root_angmom`.

    Observation (9 + 3 J + 3), in this order:

    ======= ==========================================================================
    3       velocity of the IMU in its own axes [m/s]
    3       angular velocity of the IMU in its own axes [rad/s]
    3       direction of gravity in the axes of the base
    J       angles of the joints minus those of the default pose [rad]
    J       their rates [rad/s]
    J       last action, in mjlab's units
    3       command: velocity forward and to the left [m/s], yaw rate [rad/s]
    ======= ==========================================================================

    The critic sees the same without noise and delays. mjlab's critic also sees contacts, forces and air times of the
    feet, which have no gradient: a Go1 learned less with them (lab/go1.md).

    An action turns the targets of the servos away from the default pose; see `control`. Actions and joints are in the
    order of the MJCF's joints, not in that of its actuators.

    The reward is mjlab's per second: mjlab multiplies it by the 0.02 s of a step. mjlab measures bodies 5 ms before the
    end of a step; here they are measured at its end.
    """

    Settings = VelocitySettings  # type: ignore[assignment]
    commands = (VELOCITY,)

    def prepare(self) -> None:
        self._check_names()
        super().prepare()
        self.default_height = self._start.qpos[0, 2]
        spread = self.robot.pose_spread
        self._spreads = torch.tensor(
            [by_joint(values, self.joint_names) for values in (spread.standing, spread.walking, spread.running)],
            device=self.device,
        )
        self._start_noise = _START_NOISE.to(self.device)
        self._full_ranges = self.command_ranges["velocity"][:, :3].clone()

    def _check_names(self) -> None:
        """Raise ConfigError if the model lacks parts that `robot` names, listing all that is missing.

        Missing sensors alone are no error until `observe` reads them, because a class may override it.
        """
        terms = {term.name for term in self.active_terms}
        needed = {name: kind for name, kind in _SENSORS.items() if name != "root_angmom" or "angular_momentum" in terms}
        missing_sensors = missing("sensor", needed, self.model)
        self._sensor_error = missing_sensors and f"the model of {type(self).__qualname__} has {missing_sensors}"
        if parts := missing_parts(self.robot, self.model):
            lacking = "; ".join([*parts, *([missing_sensors] if missing_sensors else [])])
            raise ConfigError(f"the model of {type(self).__qualname__} lacks what its robot names: {lacking}")

    def apply_schedules(self, epoch: int) -> None:
        super().apply_schedules(epoch)
        if (schedule := self.config.command_schedule) is not None:
            torch.mul(self._full_ranges, schedule.at(epoch), out=self.command_ranges["velocity"][:, :3])

    # Episodes

    def draw_physics(self, count: int) -> StepState:
        start = super().draw_physics(count)
        shift = self._start_noise * self.uniform(count, 4)
        turn = torch.zeros((count, 4), device=self.device)
        turn[:, 0], turn[:, 3] = torch.cos(shift[:, 3] / 2.0), torch.sin(shift[:, 3] / 2.0)
        position = start.qpos[:, :3] + shift[:, :3]
        position[:, 2] += _START_HEIGHT
        orientation = quat_multiply(turn, start.qpos[:, 3:7])
        return start._replace(qpos=torch.cat((position, orientation, start.qpos[:, 7:]), dim=-1))

    @classmethod
    def reference_settings(cls, config: AnyVelocitySettings) -> AnyVelocitySettings:
        return super().reference_settings(config).model_copy(update={"termination_height": 0.0})

    def fell(self, state: StepState) -> Tensor:
        fallen = self.has_fallen(state)
        return fallen | self.is_low(state) if self.config.termination_height > 0.0 else fallen

    def has_fallen(self, state: StepState) -> Tensor:
        """Worlds (W,) bool whose episode ends as in mjlab."""
        return self.frames(state).axis(self.robot.base, 2)[:, 2] < math.cos(_FALLEN)

    def is_low(self, state: StepState) -> Tensor:
        """Whether the base is lower than `env.termination_height`, (W,) bool."""
        return self.base_height(state) < self.config.termination_height

    def base_height(self, state: StepState) -> Tensor:
        """Height of the base above the ground [m], (W,)."""
        return state.qpos[:, 2]

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        """Differences between the base's velocity and the command, each (W,): `linear_error` [m/s] and `yaw_error`
        [rad/s], logged as `eval/linear_error` and `eval/yaw_error`."""
        command = self.velocity_command()
        linear, angular = self.base_velocities(state)
        return {
            "linear_error": torch.linalg.vector_norm(command[:, :2] - linear[:, :2], dim=-1),
            "yaw_error": (command[:, 2] - angular[:, 2]).abs(),
        }

    # What terms and observation use

    def velocity_command(self) -> Tensor:
        """Commanded velocity forward and to the left [m/s], and yaw rate [rad/s], in the current state, (W, 3)."""
        return self.measurements.once("velocity_command", self.state, self._velocity_command)

    def _velocity_command(self) -> Tensor:
        forward, left, turn, heading, *draws = self.command("velocity").unbind(-1)
        stands, goes_ahead, turns = (draw < share for draw, share in zip(draws, _SHARES, strict=True))
        error = heading - quat_yaw(self.state.physics.qpos[:, 3:7])
        error = torch.remainder(error + math.pi, 2.0 * math.pi) - math.pi
        turn_to_heading = (_HEADING_GAIN * error).clamp(*self.command_ranges["velocity"][:, 2])
        forward = torch.where(goes_ahead, forward.abs().clamp_min(_SLOWEST_AHEAD), forward)
        left, turn = left.masked_fill(goes_ahead, 0.0), turn.masked_fill(goes_ahead, 0.0)
        command = torch.stack((forward, left, torch.where(turns, turn_to_heading, turn)), dim=-1)
        return command.masked_fill(stands[:, None], 0.0)

    def commanded_speed(self) -> Tensor:
        """Size of the command, in m/s plus rad/s, (W,)."""
        command = self.velocity_command()
        return torch.linalg.vector_norm(command[:, :2], dim=-1) + command[:, 2].abs()

    def is_commanded(self) -> Tensor:
        """1 where the robot is to move, else 0, (W,)."""
        return (self.commanded_speed() > _WALKING).float()

    def pose_spread(self) -> Tensor:
        """Spread of joint angles about the default pose that `pose` tolerates at the commanded speed [rad], (W, J)."""
        speed = self.commanded_speed()
        return self._spreads[(speed >= _WALKING).long() + (speed >= _RUNNING).long()]

    def base_velocities(self, state: StepState) -> tuple[Tensor, Tensor]:
        """Velocity [m/s] and angular velocity [rad/s] of the base in its own axes, each (W, 3)."""
        return self.measurements.once("base_velocities", state, lambda: self._base_velocities(state))

    def _base_velocities(self, state: StepState) -> tuple[Tensor, Tensor]:
        frames, base = self.frames(state), self.robot.base
        into_base = quat_conjugate(frames.orientation(base))
        return quat_rotate(into_base, frames.velocity(base)), quat_rotate(into_base, frames.angular_velocity(base))

    def foot_heights(self, state: StepState) -> Tensor:
        """Heights of the feet above the ground [m], at least 0, (W, F)."""
        return self.frames(state).site_position(self.robot.feet)[..., 2].clamp_min(0.0)

    def foot_contact(self, state: StepState) -> Contact:
        """What the feet have touched of the ground in the step that led to `state`."""
        return self.contact(state, self.robot.foot_parts, self.robot.foot_kind, GROUND, "body")

    def air_time(self) -> AirTime:
        """Times of the feet in the air and on the ground [s], each (W, F), at the end of the step."""
        return AirTime.of(self.next_memory["air_time"])

    def landed(self) -> Tensor:
        """1 for feet that touched down in this step, else 0, (W, F)."""
        return self.air_time().first_contact(self.config.control_timestep).float()

    # Memory

    def memories(self) -> Mapping[str, Memory]:
        """Times of the feet in the air and on the ground [s], their heights in the current state [m], and their largest
        heights since they left the ground [m]."""
        feet = len(self.robot.feet)
        height = Memory(feet, gradient=True)
        return {
            "air_time": Memory(4 * feet),
            "foot_height": height,
            "peak_height": height,
        }

    def begin_memory(self, state: StepState) -> Mapping[str, Tensor]:
        return {"foot_height": self.foot_heights(state)}

    def remember(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        contact = self.foot_contact(state)
        times = AirTime.of(self.memory["air_time"]).after(contact.touching, self.model.opt.timestep)
        peak, height = self.memory["peak_height"], self.memory["foot_height"]
        peak = torch.where(contact.touching[-1], peak, torch.maximum(peak, height))
        return {
            "air_time": times.memory,
            "foot_height": self.foot_heights(state),
            "peak_height": peak.masked_fill(times.first_contact(self.config.control_timestep), 0.0),
        }

    # Observation

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        if self._sensor_error:
            raise ConfigError(self._sensor_error)
        sensors = self.sensors(state)
        return torch.cat(
            (
                sensors["imu_lin_vel"],
                sensors["imu_ang_vel"],
                self.gravity_in(state, self.robot.base),
                state.qpos[:, 7:] - self.default_pose,
                state.qvel[:, 6:],
                self.mjlab_action(action),
                self.velocity_command(),
            ),
            dim=-1,
        )

    def observation_layout(self) -> list[Entry]:
        return [
            *vector("imu_velocity", "m/s"),
            *vector("imu_angular_velocity", "rad/s"),
            *vector("gravity"),
            *each(self.joint_names, "angle", "rad"),
            *each(self.joint_names, "rate", "rad/s"),
            *known(entries(f"{joint}_action" for joint in self.joint_names)),
            *known(entries(("command_forward", "command_left"), "m/s")),
            *known(entries(("command_yaw_rate",), "rad/s")),
        ]


class Go1Velocity(VelocityEnv[Go1VelocitySettings]):
    """mjlab's `Mjlab-Velocity-Flat-Unitree-Go1`."""

    Settings = Go1VelocitySettings
    mjcf = "scenes/go1_flat.xml"
    robot = GO1
    terms = GO1_TERMS


class G1Velocity(VelocityEnv[G1VelocitySettings]):
    """mjlab's `Mjlab-Velocity-Flat-Unitree-G1`."""

    Settings = G1VelocitySettings
    mjcf = "scenes/g1_flat.xml"
    robot = G1
    terms = G1_TERMS
