"""The settings of the velocity tasks. Source: `mjlab/tasks/velocity` of mjlab 1.6.0."""

import math
from typing import Annotated

from pydantic import Field, PositiveFloat

from msk_ray.config.commands import Command, with_commands
from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.schedules import CommandSchedule
from msk_ray.config.sections import Count, Fraction, NonNegative, Reward
from msk_ray.config.terms import Term, terms_in
from msk_ray.envs.mjcf.config import MjcfSettings


def velocity_command(forward: tuple[float, float], turn: tuple[float, float]) -> Command:
    """The command `velocity` with these ranges of forward velocity [m/s] and yaw rate [rad/s]."""
    ranges = {
        "lin_vel_x": forward,
        "lin_vel_y": (-1.0, 1.0),
        "ang_vel_z": turn,
        "heading": (-math.pi, math.pi),
        # Compared with mjlab's shares of special commands: see `VelocityEnv.velocity_command`.
        "stand": (0.0, 1.0),
        "go_ahead": (0.0, 1.0),
        "turn_to_heading": (0.0, 1.0),
    }
    return Command("velocity", ranges, every=(3.0, 8.0))


VELOCITY = velocity_command((-1.5, 2.0), (-0.7, 0.7))
"""The command with the ranges that mjlab evaluates with on flat ground."""
ROUGH_VELOCITY = velocity_command((-1.0, 1.0), (-0.5, 0.5))
"""The command with its ranges on rough ground."""


class VelocityShape(Reward):
    """The settings of terms other than their weights."""

    tail: Fraction = 0.0
    """Share of 1/(1 + x) in the terms `track_linear_velocity` and `track_angular_velocity`, for training. In scores
    they are e^−x, which has no slope far from the command."""
    pose_tail: Fraction = 0.0
    """The same for the terms `pose`, `upright` and `base_height`."""


def velocity_terms(*others: Term) -> tuple[Term, ...]:
    """The terms that all robots of mjlab share, with its weights, and `others`."""
    return terms_in(
        "msk_ray.robots.terms",
        Term("track_linear_velocity", 2.0),
        Term("track_angular_velocity", 2.0),
        Term("upright", 1.0),
        Term("pose", 1.0, "variable_posture"),
        Term("dof_pos_limits", -1.0),
        Term("action_rate_l2", -0.1),
        Term("air_time", 0.0, gradient=False, optional=True),
        Term("foot_clearance", -2.0, optional=True),
        Term("foot_swing_height", -0.25, gradient=False, optional=True),
        Term("foot_slip", -0.1, optional=True),
        Term("soft_landing", -1e-5, gradient=False, optional=True),
        *others,
    )


class ServoSettings(MjcfSettings):
    """A robot whose joints are turned by position servos."""

    action_range: PositiveFloat = 1.0
    """mjlab's action for a policy's action of 1. mjlab's actions have no bound; an action of 1 moves the target of a
    servo so far that it starts with a quarter of its largest torque, so that 4 lets a policy ask for all of it."""


@with_commands(VELOCITY)
class VelocitySettings(ServoSettings):
    """A legged robot that follows commands for its velocity."""

    episode_length: Count = 1000
    reset_noise: NonNegative = 0.0
    """Spread of initial positions [m, rad], besides mjlab's of position and heading, which is always there."""
    reset_velocity_noise: NonNegative = 0.0
    termination_height: NonNegative = 0.0
    """In training, episodes also end when the base is lower than this [m], because a robot that has sunk into a crouch
    seldom gets out of it; 0: they do not. Scores ignore it."""
    command_schedule: CommandSchedule | None = None
    """Factor on the ranges of the commanded velocity and yaw rate in training; null: 1."""
    reward: VelocityShape = VelocityShape()


GO1_TERMS = velocity_terms(
    Term("body_ang_vel", 0.0, optional=True),
    Term("angular_momentum", 0.0, optional=True),
)
GO1_ROUGH_TERMS = (
    *(term for term in GO1_TERMS if term.name != "upright"),
    *terms_in(
        "msk_ray.robots.terms",
        Term("upright", 1.0, "upright_on_ground"),
        Term("self_collisions", -0.1, gradient=False),
        Term("shank_collision", -0.1, gradient=False),
        Term("trunk_head_collision", -0.1, gradient=False),
    ),
)
G1_TERMS = velocity_terms(
    Term("body_ang_vel", -0.05, optional=True),
    Term("angular_momentum", -0.02, optional=True),
    Term("self_collisions", -1.0, gradient=False),
    Term("base_height", 0.0, optional=True),
)
Go1Reward = reward_section("Go1Reward", __name__, GO1_TERMS, VelocityShape)
Go1RoughReward = reward_section("Go1RoughReward", __name__, GO1_ROUGH_TERMS, VelocityShape)
G1Reward = reward_section("G1Reward", __name__, G1_TERMS, VelocityShape)


@with_reward(Go1Reward)
class Go1VelocitySettings(VelocitySettings):
    """Unitree's quadruped Go1 follows commands for its velocity. mjlab's `Mjlab-Velocity-Flat-Unitree-Go1`."""


@with_commands(ROUGH_VELOCITY)
@with_reward(Go1RoughReward)
class Go1VelocityRoughSettings(VelocitySettings):
    """Unitree's quadruped Go1 follows commands on rough ground. mjlab's `Mjlab-Velocity-Rough-Unitree-Go1`."""

    terrain_rows: Annotated[int, Field(ge=2)] = 10
    """Rows of patches, from level ground to the hardest."""


@with_reward(G1Reward)
class G1VelocitySettings(VelocitySettings):
    """Unitree's humanoid G1 follows commands for its velocity. mjlab's `Mjlab-Velocity-Flat-Unitree-G1`."""
