"""The terms of MyoSuite's walking task, and those that it does not have.

Each gives a value (W,) for the `state` that a step has led to, observed as `obs`, by `action`. Axes: W worlds.
"""

import math

import torch
from torch import Tensor

from msk_ray.legs.feet import FootMotion
from msk_ray.legs.myosuite_walk.env import SPEED, MyoSuiteWalk
from msk_ray.step import StepState


def vel_reward(env: MyoSuiteWalk, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """exp(−(1.2 m/s − v)²) + exp(−u²), where v is the velocity forward and u that to the side [m/s]."""
    velocity = env.velocity(state)
    return torch.exp(-(SPEED - velocity[:, 1]).square()) + torch.exp(-velocity[:, 0].square())


def cyclic_hip(env: MyoSuiteWalk, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Distance between the flexion of both hips and 0.8 cos(φ + π) (left), 0.8 cos φ (right) [rad], where φ makes a
    turn in 100 env steps."""
    wave = torch.cos(2.0 * math.pi * env.phase(env.state.age))
    return torch.linalg.vector_norm(env.swing * wave[:, None] - state.qpos[:, env.flexions], dim=-1)


def ref_rot(env: MyoSuiteWalk, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """exp(−5 d), where d is the distance between the quaternion of the root and that of standing."""
    return torch.exp(-5.0 * torch.linalg.vector_norm(state.qpos[:, 3:7] - env.upright, dim=-1))


def joint_angle_rew(env: MyoSuiteWalk, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """exp(−5 m), where m is the mean size of both hips' adduction and rotation [rad]."""
    return torch.exp(-5.0 * state.qpos[:, env.others].abs().mean(-1))


def done(env: MyoSuiteWalk, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """1 for the step in which it falls."""
    return env.fell(state).float()


def height(env: MyoSuiteWalk, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """(Drop of the centre of mass below its height in standing)² [m²]."""
    return torch.relu(env.standing_center - env.frames(state).center_of_mass()[:, 2]).square()


def effort(env: MyoSuiteWalk, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Mean squared activation."""
    return state.act.square().mean(-1)


def footfall(env: MyoSuiteWalk, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Speed of heel and toes while people have them on the ground, if their hips swing with the phase."""
    return _feet(env, state).sliding(_leg_phase(env))


def clearance(env: MyoSuiteWalk, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """((clearance_height - height) / clearance_height)² of heel and toes below that height while people have the foot
    in the air."""
    return _feet(env, state).dragging(_leg_phase(env), env.config.reward.clearance_height)


def _leg_phase(env: MyoSuiteWalk) -> Tensor:
    """Phase of people's right leg [turns], (W,)."""
    return env.phase(env.state.age) + env.hip_lag


def _feet(env: MyoSuiteWalk, state: StepState) -> FootMotion:
    return env.feet.motion(env.frames(state), state.qpos[:, 2])
