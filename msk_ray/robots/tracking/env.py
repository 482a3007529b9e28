"""A humanoid that follows motions of people. Source: `mjlab/tasks/tracking` of mjlab 1.6.0.

Axes: W worlds, J joints but for the free one, B tracked bodies.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Final, NamedTuple

import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.layout import Entry, each, entries, vector
from msk_ray.envs.memory import Memory
from msk_ray.envs.records import EnvState, Transition
from msk_ray.robots.robots import G1
from msk_ray.robots.servos import ServoEnv
from msk_ray.robots.tracking.config import TRACKING_TERMS, G1TrackingSettings
from msk_ray.robots.tracking.references import Library, Reference, References, Source, StartFrames, library_of
from msk_ray.step import StepState
from msk_ray.step.autograd.tangent import quat_conjugate, quat_log, quat_multiply, quat_rotate

_HEIGHT: Final = 0.25
"""Error of a height with which an episode ends [m]."""
_TILT: Final = 0.8
"""Error of the vertical part of the direction of gravity, in the axes of a body, with which it does."""
_POSE_NOISE: Final = (0.05, 0.05, 0.01, 0.1, 0.1, 0.2)
"""Half the range of the initial position [m], then of roll, pitch and yaw [rad]."""
_VELOCITY_NOISE: Final = (0.5, 0.5, 0.2, 0.52, 0.52, 0.78)
"""Half the range of the base's initial velocity [m/s], then of its angular velocity [rad/s]."""
_JOINT_NOISE: Final = 0.1
"""Half the range of initial joint angles [rad]."""


class Deviation(NamedTuple):
    """What separates a state from the reference of the state before: reference minus robot, in world coordinates."""

    anchor_position: Tensor
    """[m], (W, 3)."""
    anchor_rotation: Tensor
    """Rotation vector [rad], (W, 3)."""
    position: Tensor
    """Of the bodies, where the reference is moved to the robot's anchor and turned to its heading [m], (W, B, 3)."""
    rotation: Tensor
    """The same [rad], (W, B, 3)."""
    velocity: Tensor
    """[m/s], (W, B, 3)."""
    angular_velocity: Tensor
    """[rad/s], (W, B, 3)."""


class G1Tracking(ServoEnv[G1TrackingSettings]):
    """mjlab's `Mjlab-Tracking-Flat-Unitree-G1`: Unitree's humanoid G1 follows motions.

    Observation (160 with `layout: full`, 154 without what a robot cannot measure), in this order:

    ======= ==========================================================================
    J, J    angles [rad] and rates [rad/s] of the reference's joints
    3       position of the reference's anchor in the axes of the robot's [m]; `full`
    6       first two columns of its orientation in these axes, row by row
    3       velocity of the IMU in its own axes [m/s]; `full`
    3       angular velocity of the IMU in its own axes [rad/s]
    J       angles of the joints minus those of the default pose [rad]
    J       their rates [rad/s]
    J       last action, as mjlab counts it
    ======= ==========================================================================

    then the first four for each of `future_frames`. The critic sees all of it, and position and orientation of all
    tracked bodies in the axes of the anchor, as in mjlab. The anchor is the torso.

    The reference of a world is a frame of the library: that in which its episode began, plus its age. As in mjlab, the
    reward for a step compares the state reached with the reference that the policy saw before it; the reference that
    the observation shows afterwards is the next one. Episodes are cut where a clip ends.
    """

    Settings = G1TrackingSettings  # type: ignore[assignment]
    mjcf = "../scenes/g1_flat.xml"
    robot = G1
    terms = TRACKING_TERMS
    anchor: ClassVar = "torso_link"
    bodies: ClassVar = (
        "pelvis",
        *(f"left_{part}_link" for part in ("hip_roll", "knee", "ankle_roll")),
        *(f"right_{part}_link" for part in ("hip_roll", "knee", "ankle_roll")),
        "torso_link",
        *(f"left_{part}_link" for part in ("shoulder_roll", "elbow", "wrist_yaw")),
        *(f"right_{part}_link" for part in ("shoulder_roll", "elbow", "wrist_yaw")),
    )
    """The tracked ones; the base is the first."""
    ends: ClassVar = tuple(f"{side}_{part}_link" for part in ("ankle_roll", "wrist_yaw") for side in ("left", "right"))
    """Bodies whose heights end episodes."""

    def prepare(self) -> None:
        super().prepare()
        config, rate = self.config, 1.0 / self.config.control_timestep
        self._anchor = self.bodies.index(self.anchor)
        self._ends = torch.tensor([self.bodies.index(body) for body in self.ends], device=self.device)
        library = library_of(Source.of(config, self.model, self.bodies))
        self.references = References(library, self._anchor, self.device)
        self.start_frames = StartFrames(self.references, rate, config.sampling)
        self._pose_noise = config.reset_noise * self.tensor(_POSE_NOISE)
        self._velocity_noise = config.reset_velocity_noise * self.tensor(_VELOCITY_NOISE)
        self._joint_noise = config.reset_noise * _JOINT_NOISE
        self._act = self._start.act

    @classmethod
    def library(cls, config: G1TrackingSettings) -> Library:
        """The clips of these settings.

        Raises:
            ConfigError: as for `library_of`.
        """
        return library_of(Source.of(config, cls.build_model(config, PhysicsConfig()), cls.bodies))

    @classmethod
    def reference_settings(cls, config: G1TrackingSettings) -> G1TrackingSettings:
        quiet = {"reset_noise": 0.0, "reset_velocity_noise": 0.0}
        scored = {"sampling": config.score_sampling, "failure": config.score_failure}
        return super().reference_settings(config).model_copy(update={**scored, **quiet})

    # Episodes

    def draw_physics(self, count: int) -> StepState:
        return self.draw_start(count)[0]

    def draw_start(self, count: int) -> tuple[StepState, Tensor]:
        """The numbers of an episode are the frame at age 0 and the last frame of its clip."""
        if self.config.sampling == "start":
            worlds, clips = self.nworld * self.group.size, len(self.references.lengths)
            clip = torch.arange(count, device=self.device) % worlds % clips
            first, last = self.references.firsts[clip], self.references.lasts[clip]
        else:
            first, last = self.start_frames.draw(0.5 + 0.5 * self.uniform(count, 2))
        return self._noisy(first), torch.stack((first, last), dim=-1).float()

    def _noisy(self, frame: Tensor) -> StepState:
        """States near those of frames (N,)."""
        count = len(frame)
        base, joints = (part[:, 0] for part in self.references.bodies(frame)), self.references.joints(frame)
        position, orientation, velocity, spin = base
        shift = self._pose_noise * self.uniform(count, 6)
        orientation = quat_multiply(_from_euler(shift[:, 3:]), orientation)
        push = self._velocity_noise * self.uniform(count, 6)
        angles, rates = joints.chunk(2, dim=-1)
        angles = (angles + self._joint_noise * self.uniform(count, angles.shape[1])).clamp(*self.joint_limits)
        turning = quat_rotate(quat_conjugate(orientation), spin + push[:, 3:])
        qpos = torch.cat((position + shift[:, :3], orientation, angles), dim=-1)
        qvel = torch.cat((velocity + push[:, :3], turning, rates), dim=-1)
        return StepState(qpos, qvel, self._act.repeat(count, 1))

    def spread_ages(self) -> None:
        super().spread_ages()
        numbers = self.state.numbers.clone()
        # The episode goes on in the frame whose state the world is in.
        self.task_numbers(numbers)[:, 0] -= self.state.age
        self.state = self.state._replace(numbers=numbers)

    def timed_out(self, reached: EnvState) -> Tensor:
        first, last = self.task_numbers(reached.numbers).unbind(-1)
        return super().timed_out(reached) | (first + reached.age > last)

    def step(self, action: Tensor, *, auto_reset: bool = True) -> Transition:
        frame = self.frame()
        transition = super().step(action, auto_reset=auto_reset)
        if self.config.sampling == "adaptive":
            failed = self.start_frames.failed_in(frame, transition.terminated)
            self.group.mean([failed])
            self.start_frames.count(failed)
        return transition

    def fell(self, state: StepState) -> Tensor:
        frames, reference = self.frames(state), self.reference(state)
        if self.config.failure == "pelvis":
            return self._is_off(state, reference, 0)
        height = frames.position(self.bodies)[..., 2]
        ends = (reference.position[..., 2] - height).index_select(1, self._ends).abs() > _HEIGHT
        return ends.any(-1) | self._is_off(state, reference, self._anchor)

    def _is_off(self, state: StepState, reference: Reference, body: int) -> Tensor:
        """Whether height or tilt of a tracked body is far from the reference's, (W,) bool."""
        frames, name = self.frames(state), self.bodies[body]
        height = reference.position[:, body, 2] - frames.position(name)[:, 2]
        upward = quat_rotate(reference.orientation[:, body], -self._down.expand(self.nworld, 3))[:, 2]
        tilt = upward - frames.axis(name, 2)[:, 2]
        return (height.abs() > _HEIGHT) | (tilt.abs() > _TILT)

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        """`mpkpe` is the mean distance of the tracked bodies from where the reference has them [m], `r_mpkpe` that with
        the reference moved to the robot's anchor and turned to its heading; both as mjlab's."""
        reference = self.references.bodies(self.frame(-1))
        robot = self.frames(state).position(self.bodies)
        moved = self._moved(reference, self.memory["anchor"][:, 7:])[0]
        return {
            "mpkpe": torch.linalg.vector_norm(reference.position - robot, dim=-1).mean(-1),
            "r_mpkpe": torch.linalg.vector_norm(moved - robot, dim=-1).mean(-1),
        }

    # What terms and observation use

    def frame(self, ahead: int = 0) -> Tensor:
        """The frame of the reference in the current state, or so many env steps ahead, (W,) int64."""
        first, last = self.task_numbers(self.state.numbers).unbind(-1)
        return torch.minimum(first + (self.state.age + ahead), last).long().clamp_min(0)

    def reference(self, state: StepState) -> Reference:
        """What tracked bodies are to do in the state that a step has led to."""

        def bodies() -> Reference:
            # In float64 where `diagnose` takes differences in it.
            return Reference(*(part.to(state.qpos.dtype) for part in self.references.bodies(self.frame())))

        found: Reference = self.measurements.once("reference", state, bodies)
        return found

    def deviation(self, state: StepState) -> Deviation:
        """How far the state that a step has led to is from the reference of the state in which it began."""
        found: Deviation = self.measurements.once("deviation", state, lambda: self._deviation(state))
        return found

    def _deviation(self, state: StepState) -> Deviation:
        reference, frames, anchor = self.reference(state), self.frames(state), self._anchor
        position, orientation = frames.position(self.bodies), frames.orientation(self.bodies)
        moved, turned = self._moved(reference, self.memory["anchor"][:, :7])
        return Deviation(
            reference.position[:, anchor] - position[:, anchor],
            _rotation(orientation[:, anchor], reference.orientation[:, anchor]),
            moved - position,
            _rotation(orientation, turned),
            reference.velocity - frames.velocity(self.bodies),
            reference.angular_velocity - frames.angular_velocity(self.bodies),
        )

    def _moved(self, reference: Reference, anchor: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and orientations of the reference, turned about its anchor to the heading of the robot's, (W, 7),
        and moved to where that is, except in height."""
        own, orientation = anchor.split((3, 4), dim=-1)
        theirs = reference.position[:, self._anchor]
        turn = _heading(quat_multiply(orientation, quat_conjugate(reference.orientation[:, self._anchor])))
        turns = turn[:, None].expand(-1, len(self.bodies), -1)
        to = torch.cat((own[:, :2], theirs[:, 2:]), dim=-1)
        moved = to[:, None] + quat_rotate(turns, reference.position - theirs[:, None])
        return moved, quat_multiply(turns, reference.orientation)

    def anchor_pose(self, state: StepState) -> Tensor:
        """Position and orientation of the robot's anchor, (W, 7)."""
        frames = self.frames(state)
        return torch.cat((frames.position(self.anchor), frames.orientation(self.anchor)), dim=-1)

    def mjlab_action(self, action: Tensor) -> Tensor:
        if self.config.action_about == "default":
            return super().mjlab_action(action)
        angles = self.references.joints(self.frame())[:, : self.action_size]
        return super().mjlab_action(action) + (angles - self.default_pose) / self.action_scale

    # Memory

    def memories(self) -> Mapping[str, Memory]:
        """Poses of the anchor in the current state and in the one before, and the last action, as mjlab counts it."""
        return {"anchor": Memory(14, gradient=True), "action": Memory(self.action_size, gradient=True)}

    def begin_memory(self, state: StepState) -> Mapping[str, Tensor]:
        still = torch.zeros((self.nworld, self.action_size), device=self.device)
        return {"anchor": self.anchor_pose(state).repeat(1, 2), "action": self.mjlab_action(still)}

    def remember(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        anchor = torch.cat((self.anchor_pose(state), self.memory["anchor"][:, :7]), dim=-1)
        return {"anchor": anchor, "action": self.mjlab_action(action)}

    # Observation

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return self._observed(state, full=self.config.layout == "full")

    def observe_critic(self, state: StepState, action: Tensor) -> Tensor:
        seen = self._observed(state, full=True)
        frames = self.frames(state)
        position, orientation = frames.position(self.bodies), frames.orientation(self.bodies)
        anchor = self._anchor
        place = _place(position[:, anchor, None], orientation[:, anchor, None], position, orientation)
        return torch.cat((seen, *(part.flatten(1) for part in place)), dim=-1)

    def _observed(self, state: StepState, full: bool) -> Tensor:
        frames, sensors = self.frames(state), self.sensors(state)
        own = frames.position(self.anchor), frames.orientation(self.anchor)

        def shown(ahead: int) -> tuple[Tensor, ...]:
            frame = self.frame(ahead)
            theirs = self.references.anchor(frame).to(state.qpos.dtype)
            position, orientation = _place(*own, *theirs.split((3, 4), dim=-1))
            joints = self.references.joints(frame)
            return (joints, position, orientation) if full else (joints, orientation)

        return torch.cat(
            (
                *shown(0),
                *((sensors["imu_lin_vel"],) if full else ()),
                sensors["imu_ang_vel"],
                state.qpos[:, 7:] - self.default_pose,
                state.qvel[:, 6:],
                self.memory["action"],
                *(part for ahead in self.config.future_frames for part in shown(ahead)),
            ),
            dim=-1,
        )

    def observation_layout(self) -> list[Entry]:
        full = self.config.layout == "full"

        def shown(when: str) -> list[Entry]:
            return [
                *each(self.joint_names, f"reference{when}", "rad"),
                *each(self.joint_names, f"reference_rate{when}", "rad/s"),
                *(vector(f"anchor_position{when}", "m") if full else ()),
                *entries(f"anchor_orientation{when}_{row}{column}" for row in "xyz" for column in "xy"),
            ]

        return [
            *shown(""),
            *(vector("imu_velocity", "m/s") if full else ()),
            *vector("imu_angular_velocity", "rad/s"),
            *each(self.joint_names, "angle", "rad"),
            *each(self.joint_names, "rate", "rad/s"),
            *entries(f"{joint}_action" for joint in self.joint_names),
            *(entry for ahead in self.config.future_frames for entry in shown(f"_{ahead}")),
        ]

    # Checkpoints

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "failures": self.start_frames.failures.clone()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        if state["failures"].shape == self.start_frames.failures.shape:  # else the motions have changed
            self.start_frames.failures.copy_(state["failures"])


def _rotation(start: Tensor, end: Tensor) -> Tensor:
    """Rotation vectors in world coordinates (..., 3) from one orientation to another, (..., 4)."""
    return quat_log(quat_multiply(end, quat_conjugate(start)))


def _heading(q: Tensor) -> Tensor:
    """The rotation about the vertical axis by the yaw of q, (..., 4)."""
    w, x, y, z = q.unbind(-1)
    half = 0.5 * torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    zero = torch.zeros_like(half)
    return torch.stack((torch.cos(half), zero, zero, torch.sin(half)), dim=-1)


def _from_euler(angles: Tensor) -> Tensor:
    """The rotation by roll, pitch and yaw [rad], (..., 3) to (..., 4): about x, then y, then z of the world."""
    half = 0.5 * angles
    (cr, cp, cy), (sr, sp, sy) = torch.cos(half).unbind(-1), torch.sin(half).unbind(-1)
    return torch.stack(
        (
            cy * cr * cp + sy * sr * sp,
            cy * sr * cp - sy * cr * sp,
            cy * cr * sp + sy * sr * cp,
            sy * cr * cp - cy * sr * sp,
        ),
        dim=-1,
    )


def _place(
    position: Tensor, orientation: Tensor, other_position: Tensor, other_orientation: Tensor
) -> tuple[Tensor, Tensor]:
    """Position (..., 3) and the first two columns of the orientation, row by row, (..., 6), of one frame in the axes of
    another."""
    into = quat_conjugate(orientation).expand_as(other_orientation)
    w, x, y, z = quat_multiply(into, other_orientation).unbind(-1)
    columns = (
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z)),
        *(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z)),
        *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x)),
    )
    return quat_rotate(into, other_position - position), torch.stack(columns, dim=-1)
