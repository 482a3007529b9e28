"""The reward terms of the tracking task, under mjlab's names.

Each gives a value (W,) for the `state` that a step led to, compared with the reference of the state in which the step
began, as in mjlab. Source: `tasks/tracking/mdp/rewards.py` of mjlab 1.6.0.

Axes: W worlds, B tracked bodies.
"""

from torch import Tensor

from msk_ray.robots.terms import closeness
from msk_ray.robots.tracking.env import G1Tracking
from msk_ray.step import StepState


def _close(env: G1Tracking, difference: Tensor, spread: float) -> Tensor:
    """exp(−mean over bodies of |difference|² / spread²), (W,), for one body, (W, 3), or several, (W, B, 3)."""
    square = difference.square().sum(-1)
    mean = square.mean(-1) if square.dim() > 1 else square
    return closeness(mean / spread**2, env.config.reward.tail)


def motion_global_root_pos(env: G1Tracking, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Closeness of the anchor's position, spread 0.3 m."""
    return _close(env, env.deviation(state).anchor_position, 0.3)


def motion_global_root_ori(env: G1Tracking, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Closeness of the anchor's orientation, spread 0.4 rad."""
    return _close(env, env.deviation(state).anchor_rotation, 0.4)


def motion_body_pos(env: G1Tracking, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Closeness of the bodies' positions to the reference moved to the robot's anchor, spread 0.3 m."""
    return _close(env, env.deviation(state).position, 0.3)


def motion_body_ori(env: G1Tracking, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Closeness of the bodies' orientations to the reference turned to the robot's heading, spread 0.4 rad."""
    return _close(env, env.deviation(state).rotation, 0.4)


def motion_body_lin_vel(env: G1Tracking, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Closeness of the bodies' velocities, spread 1 m/s."""
    return _close(env, env.deviation(state).velocity, 1.0)


def motion_body_ang_vel(env: G1Tracking, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Closeness of the bodies' angular velocities, spread 3.14 rad/s."""
    return _close(env, env.deviation(state).angular_velocity, 3.14)


def action_rate_l2(env: G1Tracking, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Sum of (change of mjlab's action)²."""
    return (env.next_memory["action"] - env.memory["action"]).square().sum(-1)
