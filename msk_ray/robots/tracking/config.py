"""The settings of the tracking task. Source: `mjlab/tasks/tracking` of mjlab 1.6.0."""

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, model_validator

from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.sections import Count, Fraction, NonNegative, Reward, Text
from msk_ray.config.terms import Term, terms_in
from msk_ray.robots.config import ServoSettings

Sampling = Literal["failure_rate", "uniform", "start"]
Failure = Literal["mjlab", "pelvis"]
Offset = Annotated[int, Field(ge=1, le=1000)]


class TrackingShape(Reward):
    """The settings of terms other than their weights."""

    tail: Fraction = 0.0
    """Share of 1/(1 + x) in the six motion terms, for training. In scores they are e^−x, which has no slope far from
    the motion."""


TRACKING_TERMS = terms_in(
    "msk_ray.robots.tracking.terms",
    Term("motion_global_root_pos", 0.5),
    Term("motion_global_root_ori", 0.5),
    Term("motion_body_pos", 1.0),
    Term("motion_body_ori", 1.0),
    Term("motion_body_lin_vel", 1.0),
    Term("motion_body_ang_vel", 1.0),
    Term("action_rate_l2", -0.1),
    Term("joint_limit", -10.0, "msk_ray.robots.terms:dof_pos_limits"),
    Term("self_collisions", -10.0, "msk_ray.robots.terms:self_collisions", gradient=False),
)
MOTION_TERMS = tuple(term.name for term in TRACKING_TERMS if term.name.startswith("motion_"))
"""The terms that measure how close the robot is to the motion; each is at most 1, times its weight."""
G1TrackingReward = reward_section("G1TrackingReward", __name__, TRACKING_TERMS, TrackingShape)


@with_reward(G1TrackingReward)
class G1TrackingSettings(ServoSettings):
    """Unitree's humanoid G1 follows motions of people. mjlab's `Mjlab-Tracking-Flat-Unitree-G1`."""

    episode_length: Count = 500
    reset_noise: NonNegative = 1.0
    """Share of mjlab's noise in initial poses, which is at most 5 cm along x and y, 1 cm along z, 0.1 rad of roll and
    pitch, 0.2 rad of yaw, and 0.1 rad in each joint. 0 in scores."""
    reset_velocity_noise: NonNegative = 1.0
    """Share of mjlab's noise in initial velocities of the base, which is at most 0.5 m/s along x and y, 0.2 m/s along
    z, 0.52 rad/s of roll and pitch, and 0.78 rad/s of yaw. 0 in scores."""
    motion: Text = "builtin:squat"
    """Motions to follow: a file .csv or .npz, a folder of them, or a built-in one."""
    cut: tuple[NonNegative, NonNegative] | None = None
    """Part of each motion to follow, from one time to another [s]; null: all of it."""
    mirror: bool = False
    """Follow each motion's mirror image too."""
    layout: Literal["full", "no_state_estimation"] = "full"
    """What the policy sees. `full` includes the position of the reference's torso and the velocity of the IMU, which a
    real robot cannot measure; `no_state_estimation` (mjlab's name) leaves both out. The critic sees the full layout and
    the pose of every tracked body in either case."""
    future_frames: tuple[Offset, ...] = ()
    """The policy also sees the reference this many env steps ahead, such as [1, 2, 4, 8]."""
    action_about: Literal["default", "reference"] = "default"
    """Joint targets for an action of 0: the default pose, as in mjlab, or the reference's angles."""
    sampling: Sampling = "failure_rate"
    """Where training episodes begin: anywhere, but more often where many of those that got there failed
    (`failure_rate`); anywhere (`uniform`); or at the first frame of each motion (`start`). mjlab prefers seconds with
    many failures, even if most episodes pass them (lab/g1_tracking.md#all-of-the-torque)."""
    score_sampling: Literal["uniform", "start"] = "uniform"
    """Where scored episodes begin."""
    failure: Failure = "mjlab"
    """When a training episode ends early: as in mjlab, when the height or tilt of the torso or the height of a hand or
    foot is far off (`mjlab`), or when the height or tilt of the pelvis is (`pelvis`)."""
    drift_limit: PositiveFloat | None = None
    """Training episodes also end when the torso is farther than this, horizontally, from the reference's [m]. Without
    it, a robot that walks more slowly than a motion loses little, because the reward for the torso's position has
    hardly any slope far from it."""
    score_failure: Failure = "mjlab"
    """When a scored episode ends early."""
    reward: TrackingShape = TrackingShape()

    @model_validator(mode="after")
    def _cut_in_order(self) -> "G1TrackingSettings":
        if self.cut is not None and self.cut[0] >= self.cut[1]:
            raise ValueError(f"env.cut: {self.cut[0]:g} to {self.cut[1]:g} s is no part of a motion")
        return self
