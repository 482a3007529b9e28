"""Unitree's Go1 and G1. Source: `mjlab/tasks/velocity/config` of mjlab 1.6.0.

Action scales are computed from the models' servos (`servos.py`).
"""

from typing import Final

from msk_ray.robots.robot import PoseSpread, Robot

_LEGS = ("FR", "FL", "RR", "RL")
_GO1_MOVING = {".*_(hip|thigh)_joint": 0.3, ".*_calf_joint": 0.6}

GO1: Final = Robot(
    base="trunk",
    trunk="trunk",
    feet=_LEGS,
    foot_parts=tuple(f"{leg}_foot_collision" for leg in _LEGS),
    foot_kind="geom",
    pose_spread=PoseSpread(
        standing={".*_(hip|thigh)_joint": 0.05, ".*_calf_joint": 0.1}, walking=_GO1_MOVING, running=_GO1_MOVING
    ),
)
"""A quadruped with 12 joints."""

G1: Final = Robot(
    base="pelvis",
    trunk="torso_link",
    feet=("left_foot", "right_foot"),
    foot_parts=("left_ankle_roll_link", "right_ankle_roll_link"),
    foot_kind="subtree",
    pose_spread=PoseSpread(
        standing={".*": 0.05},
        walking={
            ".*hip_pitch.*": 0.3,
            ".*hip_(roll|yaw).*": 0.15,
            ".*knee.*": 0.35,
            ".*ankle_pitch.*": 0.25,
            ".*ankle_roll.*": 0.1,
            ".*waist_yaw.*": 0.2,
            ".*waist_roll.*": 0.08,
            ".*waist_pitch.*": 0.1,
            ".*shoulder_(pitch|roll).*": 0.15,
            ".*shoulder_yaw.*": 0.1,
            ".*elbow.*": 0.15,
            ".*wrist.*": 0.3,
        },
        running={
            ".*hip_pitch.*": 0.5,
            ".*hip_(roll|yaw).*": 0.2,
            ".*knee.*": 0.6,
            ".*ankle_pitch.*": 0.35,
            ".*ankle_roll.*": 0.15,
            ".*waist_yaw.*": 0.3,
            ".*waist_roll.*": 0.08,
            ".*waist_pitch.*": 0.2,
            ".*shoulder_pitch.*": 0.5,
            ".*shoulder_roll.*": 0.2,
            ".*shoulder_yaw.*": 0.15,
            ".*elbow.*": 0.35,
            ".*wrist.*": 0.3,
        },
    ),
)
"""A humanoid with 29 joints."""
