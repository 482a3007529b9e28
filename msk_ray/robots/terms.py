"""The reward terms of the velocity tasks, under mjlab's names, for classes derived from `VelocityEnv`.

Each gives a value (W,) for the `state` that a step by `action` led to, with its observation `obs`. The command is the
one of the state in which the step began.

Source: `tasks/velocity/mdp/rewards.py` and `envs/mdp/rewards.py` of mjlab 1.6.0.

Axes: W worlds, J joints, F feet.
"""

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from msk_ray.robots.env import VelocityEnv
from msk_ray.robots.servos import ServoEnv
from msk_ray.step import StepState

if TYPE_CHECKING:
    from msk_ray.robots.rough import Go1VelocityRough

Robots = VelocityEnv[Any]

_SWING_HEIGHT = 0.1
"""Height that a foot should reach in swing [m]."""
_HEIGHT_SPREAD = 0.1
"""Difference from the default height at which `base_height` is e^−1 [m]."""
_AIR_TIME = 0.05, 0.5
"""Shortest and longest time in the air that `air_time` rewards [s]."""
_AIR_TIME_SPEED = 0.5
"""Commanded speed above which `air_time` rewards anything, in m/s plus rad/s."""
COLLISION_FORCE = 10.0
"""Force above which a collision counts [N]."""


def closeness(relative: Tensor, tail: float) -> Tensor:
    """e^−x, or with a `tail` > 0, as in training, a mixture with that share of 1/(1 + x)."""
    close = torch.exp(-relative)
    return close if tail == 0.0 else torch.lerp(close, 1.0 / (1.0 + relative), tail)


def track_linear_velocity(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """exp(−|v − command|² / 0.25), where v is the base's velocity and the command's vertical part is 0 [m/s].

    In training, `env.reward.tail` gives it a slope far from the command.
    """
    velocity, _ = env.base_velocities(state)
    error = (env.velocity_command()[:, :2] - velocity[:, :2]).square().sum(-1) + velocity[:, 2].square()
    return closeness(error / 0.25, env.config.reward.tail)


def track_angular_velocity(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """exp(−|ω − command|² / 0.5), where ω is the base's angular velocity and the command is for yaw alone [rad/s].

    In training, `env.reward.tail` gives it a slope far from the command.
    """
    _, spin = env.base_velocities(state)
    error = (env.velocity_command()[:, 2] - spin[:, 2]).square() + spin[:, :2].square().sum(-1)
    return closeness(error / 0.5, env.config.reward.tail)


def upright(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """exp(−s² / 0.2), where s is the sine of the trunk's tilt. In training, `env.reward.pose_tail` gives it a slope."""
    tilt = env.gravity_in(state, env.robot.trunk)[:, :2].square().sum(-1)
    return closeness(tilt / 0.2, env.config.reward.pose_tail)


def upright_on_ground(env: "Go1VelocityRough", state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """exp(−s² / 0.2), where s is the sine of the angle between the trunk and the normal of the ground around it."""
    return closeness(env.tilt_to_ground(state) / 0.2, env.config.reward.pose_tail)


def variable_posture(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """exp(−mean (distance from the default pose / spread)²), where the spread of each joint depends on the command.

    In training, `env.reward.pose_tail` gives it a slope far from that pose.
    """
    distance = (state.qpos[:, 7:] - env.default_pose) / env.pose_spread()
    return closeness(distance.square().mean(-1), env.config.reward.pose_tail)


def base_height(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """exp(−(height of the base − its default)² / (0.1 m)²). Not in mjlab: a slope out of a crouch, for training.

    `env.reward.pose_tail` gives it a slope far from the default height as well.
    """
    distance = (env.base_height(state) - env.default_height) / _HEIGHT_SPREAD
    return closeness(distance.square(), env.config.reward.pose_tail)


def body_ang_vel(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """(Angular velocity of the trunk about the world's horizontal axes)² [rad²/s²]."""
    return env.frames(state).angular_velocity(env.robot.trunk)[:, :2].square().sum(-1)


def angular_momentum(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """(Angular momentum of the robot about its centre of mass)² [kg² m⁴/s²]."""
    return env.sensors(state)["root_angmom"].square().sum(-1)


def dof_pos_limits(env: ServoEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Sum over the joints of the angle beyond 90 % of the range [rad]."""
    low, high = env.joint_limits
    angles = state.qpos[:, 7:]
    return (torch.relu(low - angles) + torch.relu(angles - high)).sum(-1)


def action_rate_l2(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Sum of (change of mjlab's action)²."""
    return env.mjlab_action(action - env.state.action).square().sum(-1)


def air_time(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Number of feet that have been in the air for 0.05 to 0.5 s. No slope."""
    time, (shortest, longest) = env.air_time().air, _AIR_TIME
    flying = ((time > shortest) & (time < longest)).sum(-1)
    return flying.float() * (env.commanded_speed() > _AIR_TIME_SPEED)


def foot_clearance(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Sum over the feet of |height − 0.1 m| × horizontal speed [m²/s].

    The height is the one at the start of the step, as in mjlab, which measures heights once a step.
    """
    distance = (env.memory["foot_height"] - _SWING_HEIGHT).abs()
    return (distance * _foot_speed(env, state)).sum(-1) * env.is_commanded()


def foot_swing_height(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Sum over the feet that land of (largest height in the swing / 0.1 m − 1)².

    It has a slope with respect to the state of the largest height, if that is within the horizon, but none with respect
    to landing.
    """
    error = env.memory["peak_height"] / _SWING_HEIGHT - 1.0
    return (error.square() * env.landed()).sum(-1) * env.is_commanded()


def foot_slip(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Sum over the feet on the ground of (horizontal speed)² [m²/s²]. Whether a foot is on the ground has no slope."""
    on_ground = (env.air_time().contact > 0.0).float()
    return (_foot_speed(env, state).square() * on_ground).sum(-1) * env.is_commanded()


def soft_landing(env: Robots, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Sum over the feet that land of the force on them [N]. No slope."""
    force = torch.linalg.vector_norm(env.foot_contact(state).force, dim=-1)
    return (force * env.landed()).sum(-1) * env.is_commanded()


def self_collisions(env: ServoEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Number of substeps in which parts of the robot press on each other with more than 10 N. No slope.

    Of the contacts in a substep, mjlab looks at the one that comes first; this term looks at the strongest.
    """
    contact = env.contact(state, env.robot.base, "subtree", env.robot.base, "subtree")
    return (contact.strongest[..., 0] > COLLISION_FORCE).sum(0).float()


def shank_collision(env: "Go1VelocityRough", state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Number of substeps in which a shank hits the ground with more than 10 N. No slope."""
    return env.hits(state, env.shanks).float()


def trunk_head_collision(env: "Go1VelocityRough", state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Number of substeps in which trunk or head hits the ground with more than 10 N. No slope."""
    return env.hits(state, env.trunk_and_head).float()


def _foot_speed(env: Robots, state: StepState) -> Tensor:
    """Horizontal speeds of the feet [m/s], (W, F)."""
    return torch.linalg.vector_norm(env.frames(state).site_velocity(env.robot.feet)[..., :2], dim=-1)
