"""A humanoid that follows motions of people. Source: `mjlab/tasks/tracking` of mjlab 1.6.0.

Axes: W worlds, J joints except the free one, B tracked bodies, N episodes.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Final, NamedTuple

import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.layout import Entry, each, entries, known, vector
from msk_ray.envs.memory import Memory
from msk_ray.envs.records import EnvState, Transition
from msk_ray.errors import ConfigError
from msk_ray.robots.servos import ServoEnv
from msk_ray.robots.tracking.config import TRACKING_TERMS, G1TrackingSettings
from msk_ray.robots.tracking.references import Library, Reference, References, Source, StartFrames, library_of
from msk_ray.robots.unitree import G1
from msk_ray.step import StepState
from msk_ray.step.autograd.tangent import quat_conjugate, quat_log, quat_multiply, quat_rotate, quat_yaw

_LARGEST_HEIGHT_ERROR: Final = 0.25
"""Beyond it an episode ends [m]."""
_LARGEST_TILT_ERROR: Final = 0.8
"""Beyond it an episode ends; the tilt is the vertical component of the direction of gravity in a body's axes."""
_POSE_NOISE: Final = (0.05, 0.05, 0.01, 0.1, 0.1, 0.2)
"""Largest noise of the base's initial position [m], then of its roll, pitch and yaw [rad]."""
_VELOCITY_NOISE: Final = (0.5, 0.5, 0.2, 0.52, 0.52, 0.78)
"""Largest noise of the base's initial velocity [m/s], then of its angular velocity [rad/s]."""
_JOINT_NOISE: Final = 0.1
"""Largest noise of initial joint angles [rad]."""


class Deviation(NamedTuple):
    """Reference minus robot, in world coordinates."""

    anchor_position: Tensor
    """Of the anchor [m], (W, 3)."""
    anchor_rotation: Tensor
    """Of the anchor, a rotation vector [rad], (W, 3)."""
    position: Tensor
    """Of the tracked bodies, after the reference is moved to the robot's anchor and turned to the robot's heading [m],
    (W, B, 3)."""
    rotation: Tensor
    """Of the tracked bodies after the same turn, rotation vectors [rad], (W, B, 3)."""
    velocity: Tensor
    """Of the tracked bodies [m/s], (W, B, 3)."""
    angular_velocity: Tensor
    """Of the tracked bodies [rad/s], (W, B, 3)."""


class G1Tracking(ServoEnv[G1TrackingSettings]):
    """mjlab's `Mjlab-Tracking-Flat-Unitree-G1`: Unitree's humanoid G1 follows motions.

    The anchor is the torso. Observation (160 with `layout: full`; 154 with `no_state_estimation`, which lacks the rows
    marked `full`), in this order:

    ======= ==========================================================================
    J, J    angles [rad] and rates [rad/s] of the reference's joints
    3       position of the reference's anchor in the axes of the robot's [m]; `full`
    6       its rotation matrix in these axes: the first two columns, row by row
    3       velocity of the IMU in its own axes [m/s]; `full`
    3       angular velocity of the IMU in its own axes [rad/s]
    J       angles of the joints minus those of the default pose [rad]
    J       their rates [rad/s]
    J       last action, in mjlab's units
    ======= ==========================================================================

    followed by the first three rows again for each of `future_frames`. As in mjlab, the critic sees the full layout,
    and then the position and orientation of every tracked body in the axes of the robot's anchor.

    A world's reference is a frame of the library: the frame in which its episode began plus the episode's age. As in
    mjlab, the reward for a step compares the state it led to with the reference that the policy saw before the step;
    the next observation shows the next reference. Episodes time out at the end of their clip.
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
    """The tracked bodies; the base comes first."""
    hands_and_feet: ClassVar = tuple(
        f"{side}_{part}_link" for part in ("ankle_roll", "wrist_yaw") for side in ("left", "right")
    )
    """Tracked bodies that end an episode when their height is far off."""

    def prepare(self) -> None:
        super().prepare()
        config, rate = self.config, 1.0 / self.config.control_timestep
        self._anchor = self.bodies.index(self.anchor)
        limbs = [self.bodies.index(body) for body in self.hands_and_feet]
        self._hands_and_feet = torch.tensor(limbs, device=self.device)
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
        scored = {"sampling": config.score_sampling, "failure": config.score_failure, "drift_limit": None}
        return super().reference_settings(config).model_copy(update={**scored, **quiet})

    # Episodes

    def draw_physics(self, count: int) -> StepState:
        return self.draw_start(count)[0]

    def draw_start(self, count: int) -> tuple[StepState, Tensor]:
        """Initial states, and as numbers of each episode its frame at age 0 and the last frame of its clip, (N, 2)."""
        if self.config.sampling == "start":
            worlds, clips = self.nworld * self.group.size, len(self.references.lengths)
            clip = torch.arange(count, device=self.device) % worlds % clips
            first, last = self.references.firsts[clip], self.references.lasts[clip]
        else:
            first, last = self.start_frames.draw(0.5 + 0.5 * self.uniform(count, 2))
        return self._noisy(first), torch.stack((first, last), dim=-1).float()

    def _noisy(self, frame: Tensor) -> StepState:
        """The states in frames (N,), with noise in pose and velocity."""
        count = len(frame)
        position, orientation, velocity, spin = (part[:, 0] for part in self.references.bodies(frame))
        angles, rates = self.references.joints(frame).chunk(2, dim=-1)
        shift = self._pose_noise * self.uniform(count, 6)
        orientation = quat_multiply(_from_euler(shift[:, 3:]), orientation)
        change = self._velocity_noise * self.uniform(count, 6)
        angles = (angles + self._joint_noise * self.uniform(count, angles.shape[1])).clamp(*self.joint_limits)
        spin_in_base = quat_rotate(quat_conjugate(orientation), spin + change[:, 3:])
        qpos = torch.cat((position + shift[:, :3], orientation, angles), dim=-1)
        qvel = torch.cat((velocity + change[:, :3], spin_in_base, rates), dim=-1)
        return StepState(qpos, qvel, self._act.repeat(count, 1))

    def spread_ages(self) -> None:
        super().spread_ages()
        numbers = self.state.numbers.clone()
        # A world is in the state of its first frame, so that frame now belongs to the age it was given.
        self.task_numbers(numbers)[:, 0] -= self.state.age
        self.state = self.state._replace(numbers=numbers)

    def timed_out(self, reached: EnvState) -> Tensor:
        first, last = self.task_numbers(reached.numbers).unbind(-1)
        return super().timed_out(reached) | (first + reached.age > last)

    def step(self, action: Tensor, *, auto_reset: bool = True) -> Transition:
        frame = self.frame()
        transition = super().step(action, auto_reset=auto_reset)
        if self.config.sampling == "failure_rate":
            tally = self.start_frames.tally(frame, transition.terminated)
            self.group.mean([tally])
            self.start_frames.count(tally)
        return transition

    def fell(self, state: StepState) -> Tensor:
        off = self._is_posed_off(state)
        limit = self.config.drift_limit
        if limit is None:
            return off
        drift = self.deviation(state).anchor_position[:, :2]
        return off | (torch.linalg.vector_norm(drift, dim=-1) > limit)

    def _is_posed_off(self, state: StepState) -> Tensor:
        """Whether heights or tilts are far from the reference's, (W,) bool."""
        frames, reference = self.frames(state), self.reference(state)
        if self.config.failure == "pelvis":
            return self._is_off(state, reference, 0)
        height_error = reference.position[..., 2] - frames.position(self.bodies)[..., 2]
        limbs_are_off = height_error.index_select(1, self._hands_and_feet).abs() > _LARGEST_HEIGHT_ERROR
        return limbs_are_off.any(-1) | self._is_off(state, reference, self._anchor)

    def _is_off(self, state: StepState, reference: Reference, body: int) -> Tensor:
        """Whether the height or tilt of tracked body number `body` is far from the reference's, (W,) bool."""
        frames, name = self.frames(state), self.bodies[body]
        height_error = reference.position[:, body, 2] - frames.position(name)[:, 2]
        upward = quat_rotate(reference.orientation[:, body], -self._down.expand(self.nworld, 3))[:, 2]
        tilt_error = upward - frames.axis(name, 2)[:, 2]
        return (height_error.abs() > _LARGEST_HEIGHT_ERROR) | (tilt_error.abs() > _LARGEST_TILT_ERROR)

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        """mjlab's `mpkpe`, the mean distance of the tracked bodies from the reference [m], and its `r_mpkpe`, the same
        after moving the reference to the robot's anchor and turning it to the robot's heading."""
        # The current state is already the one reached: the reference of the step is one frame back.
        reference = self.references.bodies(self.frame(-1))
        robot = self.frames(state).position(self.bodies)
        moved = self._moved_to_robot(reference, self.memory["anchor"][:, 7:])[0]
        return {
            "mpkpe": torch.linalg.vector_norm(reference.position - robot, dim=-1).mean(-1),
            "r_mpkpe": torch.linalg.vector_norm(moved - robot, dim=-1).mean(-1),
        }

    # What terms and observation use

    def frame(self, ahead: int = 0) -> Tensor:
        """The reference's frame `ahead` env steps after the current state, at most its clip's last, (W,) int64."""
        first, last = self.task_numbers(self.state.numbers).unbind(-1)
        return torch.minimum(first + (self.state.age + ahead), last).long().clamp_min(0)

    def reference(self, state: StepState) -> Reference:
        """The reference that a state reached by a step is compared with, in the dtype of the state."""

        def look_up() -> Reference:
            # `diagnose` takes finite differences in float64.
            return Reference(*(part.to(state.qpos.dtype) for part in self.references.bodies(self.frame())))

        return self.measurements.once("reference", state, look_up)

    def deviation(self, state: StepState) -> Deviation:
        """Deviation of a state reached by a step from its `reference`."""
        return self.measurements.once("deviation", state, lambda: self._deviation(state))

    def _deviation(self, state: StepState) -> Deviation:
        reference, frames, anchor = self.reference(state), self.frames(state), self._anchor
        position, orientation = frames.position(self.bodies), frames.orientation(self.bodies)
        moved, turned = self._moved_to_robot(reference, self.memory["anchor"][:, :7])
        return Deviation(
            reference.position[:, anchor] - position[:, anchor],
            _rotation_between(orientation[:, anchor], reference.orientation[:, anchor]),
            moved - position,
            _rotation_between(orientation, turned),
            reference.velocity - frames.velocity(self.bodies),
            reference.angular_velocity - frames.angular_velocity(self.bodies),
        )

    def _moved_to_robot(self, reference: Reference, anchor: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (W, B, 3) and orientations (W, B, 4) of the reference, moved horizontally to the robot's anchor and
        turned to its heading.

        Args:
            reference: the reference.
            anchor: position and orientation of the robot's anchor, (W, 7).
        """
        robot_position, robot_orientation = anchor.split((3, 4), dim=-1)
        reference_position = reference.position[:, self._anchor]
        turn = _heading(quat_multiply(robot_orientation, quat_conjugate(reference.orientation[:, self._anchor])))
        turns = turn[:, None].expand(-1, len(self.bodies), -1)
        target = torch.cat((robot_position[:, :2], reference_position[:, 2:]), dim=-1)
        moved = target[:, None] + quat_rotate(turns, reference.position - reference_position[:, None])
        return moved, quat_multiply(turns, reference.orientation)

    def anchor_pose(self, state: StepState) -> Tensor:
        """Position [m] and orientation of the robot's anchor, (W, 7)."""
        frames = self.frames(state)
        return torch.cat((frames.position(self.anchor), frames.orientation(self.anchor)), dim=-1)

    def reference_qpos(self) -> Tensor:
        """The reference's pose in the current state."""
        frame = self.frame()
        base = self.references.bodies(frame)
        angles = self.references.joints(frame)[:, : self.action_size]
        return torch.cat((base.position[:, 0], base.orientation[:, 0], angles), dim=-1)

    def mjlab_action(self, action: Tensor) -> Tensor:
        if self.config.action_about == "default":
            return super().mjlab_action(action)
        angles = self.references.joints(self.frame())[:, : self.action_size]
        return super().mjlab_action(action) + (angles - self.default_pose) / self.action_scale

    # Memory

    def memories(self) -> Mapping[str, Memory]:
        """Poses of the anchor in the current state and the one before, and the last action in mjlab's units."""
        return {"anchor": Memory(14, gradient=True), "action": Memory(self.action_size, gradient=True)}

    def begin_memory(self, state: StepState) -> Mapping[str, Tensor]:
        zero_action = torch.zeros((self.nworld, self.action_size), device=self.device)
        return {"anchor": self.anchor_pose(state).repeat(1, 2), "action": self.mjlab_action(zero_action)}

    def remember(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        anchor = torch.cat((self.anchor_pose(state), self.memory["anchor"][:, :7]), dim=-1)
        return {"anchor": anchor, "action": self.mjlab_action(action)}

    # Observation

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return self._observation_of(state, full=self.config.layout == "full")

    def observe_critic(self, state: StepState, action: Tensor) -> Tensor:
        full_layout = self._observation_of(state, full=True)
        frames = self.frames(state)
        position, orientation = frames.position(self.bodies), frames.orientation(self.bodies)
        anchor = self._anchor
        poses = _pose_in_axes(position[:, anchor, None], orientation[:, anchor, None], position, orientation)
        return torch.cat((full_layout, *(part.flatten(1) for part in poses)), dim=-1)

    def _observation_of(self, state: StepState, full: bool) -> Tensor:
        """The observation, with the entries that a robot cannot measure if it is `full`."""
        if state is not self.state.physics:  # as in comparisons with finite differences
            return self._compute_observation(state, full)
        return self.measurements.once(("observation", full), self.state, lambda: self._compute_observation(state, full))

    def _compute_observation(self, state: StepState, full: bool) -> Tensor:
        frames, sensors = self.frames(state), self.sensors(state)
        robot_anchor = frames.position(self.anchor), frames.orientation(self.anchor)

        def reference_entries(ahead: int) -> tuple[Tensor, ...]:
            frame = self.frame(ahead)
            reference_anchor = self.references.anchor(frame).to(state.qpos.dtype)
            position, orientation = _pose_in_axes(*robot_anchor, *reference_anchor.split((3, 4), dim=-1))
            joints = self.references.joints(frame)
            return (joints, position, orientation) if full else (joints, orientation)

        return torch.cat(
            (
                *reference_entries(0),
                *((sensors["imu_lin_vel"],) if full else ()),
                sensors["imu_ang_vel"],
                state.qpos[:, 7:] - self.default_pose,
                state.qvel[:, 6:],
                self.memory["action"],
                *(part for ahead in self.config.future_frames for part in reference_entries(ahead)),
            ),
            dim=-1,
        )

    def observation_layout(self) -> list[Entry]:
        full = self.config.layout == "full"

        def reference_entries(suffix: str) -> list[Entry]:
            return [
                *known(each(self.joint_names, f"reference{suffix}", "rad")),
                *known(each(self.joint_names, f"reference_rate{suffix}", "rad/s")),
                *(vector(f"anchor_position{suffix}", "m") if full else ()),
                *entries(f"anchor_orientation{suffix}_{row}{column}" for row in "xyz" for column in "xy"),
            ]

        return [
            *reference_entries(""),
            *(vector("imu_velocity", "m/s") if full else ()),
            *vector("imu_angular_velocity", "rad/s"),
            *each(self.joint_names, "angle", "rad"),
            *each(self.joint_names, "rate", "rad/s"),
            *known(entries(f"{joint}_action" for joint in self.joint_names)),
            *(entry for ahead in self.config.future_frames for entry in reference_entries(f"_{ahead}")),
        ]

    # Checkpoints

    def state_dict(self) -> dict[str, Any]:
        frames = self.start_frames
        return {**super().state_dict(), "failures": frames.failures.clone(), "visits": frames.visits.clone()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if state["failures"].shape != self.start_frames.failures.shape:
            raise ConfigError(
                f"env.motion: the motions in {self.config.motion} have changed since this trial was saved: restore "
                "them, or start another trial"
            )
        super().load_state_dict(state)
        self.start_frames.failures.copy_(state["failures"])
        self.start_frames.visits.copy_(state["visits"])


def _rotation_between(start: Tensor, end: Tensor) -> Tensor:
    """Rotation vectors in world coordinates [rad], (..., 3), that turn one orientation into another, each (..., 4)."""
    return quat_log(quat_multiply(end, quat_conjugate(start)))


def _heading(q: Tensor) -> Tensor:
    """The rotations about the vertical axis by the yaw of orientations q, both (..., 4)."""
    half = 0.5 * quat_yaw(q)
    zero = torch.zeros_like(half)
    return torch.stack((torch.cos(half), zero, zero, torch.sin(half)), dim=-1)


def _from_euler(angles: Tensor) -> Tensor:
    """Quaternions (..., 4) of rotations by roll, pitch and yaw [rad], (..., 3): about the world's x, then y, then z."""
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


def _pose_in_axes(
    position: Tensor, orientation: Tensor, other_position: Tensor, other_orientation: Tensor
) -> tuple[Tensor, Tensor]:
    """Pose of another frame in the axes of one with this position (..., 3) and orientation (..., 4).

    Returns:
        Position (..., 3), and the first two columns of the rotation matrix, row by row, (..., 6).
    """
    into = quat_conjugate(orientation).expand_as(other_orientation)
    w, x, y, z = quat_multiply(into, other_orientation).unbind(-1)
    columns = (
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z)),
        *(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z)),
        *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x)),
    )
    return quat_rotate(into, other_position - position), torch.stack(columns, dim=-1)
