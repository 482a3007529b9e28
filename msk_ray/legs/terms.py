"""The terms of the legs' reward, in the order of `config.TERMS`, which has their weights.

Each gives a value (W,) for the `state` that a step has led to, observed as `obs`, by `action`. Axes: W worlds.
"""

import math
from typing import Any

import torch
from torch import Tensor

from msk_ray.envs.limited_body import squared_overshoot
from msk_ray.legs import costs
from msk_ray.legs.env import LegEnv
from msk_ray.step import StepState

_TRUNK_LEVER = 0.18
"""How far the centre of mass moves with the trunk's up axis [m]: 34 kg of 75 kg, 0.4 m above the pelvis."""
_HEAD_LEVER = 0.65
"""Height of the head above the pelvis [m]."""
_CAPTURE = 0.1
"""Distance of the capture point beyond which its cost grows linearly [m], so that the cost of a fall stays moderate."""
_STRIDE = 0.75
"""Largest angle between the hips' flexions [rad]: 2 asin(step length / (2 leg length)) for 0.67 m and 0.9 m."""
_CADENCE = 112.0
"""Steps per minute, about as many as people take at 1.25 m/s [1/min]."""
_TRACK, _TRACK_RATE = 0.15, 2.0
"""Distances from people's joint angles [rad] and their rates [rad/s] beyond which the cost grows linearly."""
_LEG_LENGTH = 0.9
"""Leg whose steps have the length of people's [m]."""


def forward_vel(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """exp(-((v - env.target_speed) / speed_scale)²) of the forward speed v."""
    return torch.exp(-((env.speed(state) - env.target) / env.config.reward.speed_scale).square())


def progress(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """The forward speed, up to env.target_speed [m/s]: a slope where the term above is flat."""
    speed, target = env.speed(state), env.target
    return torch.minimum(speed, target) if isinstance(target, Tensor) else speed.clamp_max(target)


def upright(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Cosine between the trunk's up axis and +z."""
    return env.root(state).up.unbind(-1)[2]


def heading(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Cosine between the pelvis's forward axis and +x."""
    return env.root(state).heading


def height(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """(Drop below the standing height)² [m²]."""
    return torch.relu(env.stand_height - env.root(state).height).square()


def alive(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """1 for every step without a fall."""
    return torch.ones_like(env.root(state).height)


def effort(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Mean squared activation; zero at rest."""
    return state.act.square().mean(-1)


def joint_limit(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Summed squared overshoot past the joint limits, minus a margin of 0.05 rad, in units of 0.1 rad."""
    return squared_overshoot(state.qpos[:, env.hinge_qpos], *env.hinge_limits)


def smoothness(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Mean squared change of the action."""
    age = env.state.age
    return (env.own_sides(action, age) - env.own_sides(env.state.action, age - 1)).square().mean(-1)


def capture(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """√(1 + (d / 0.1 m)²) - 1, where d is the distance of the capture point from the walking line, or from the
    start when standing. The capture point is where the body would come to rest as a pendulum, x + v / √(g / height),
    with x and v of its centre of mass estimated from pelvis and lean of the trunk."""
    root = env.root(state)
    # The trunk is half of the body: the centre of mass moves with its lean.
    velocity = root.velocity + _TRUNK_LEVER * torch.linalg.cross(root.spin, root.up)
    place = root.place + (velocity * env.pendulum_time + _TRUNK_LEVER * (root.up - env.standing_up))[:, :2]
    distance = place if env.config.target_speed == 0.0 else place[:, 1:]
    return torch.sqrt(1.0 + (distance / _CAPTURE).square().sum(-1)) - 1.0


def sway(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Squared angular velocity of the pelvis [rad²/s²]."""
    return env.root(state).spin.square().sum(-1)


def symmetry(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Squared sum of both hips' flexion rates [rad²/s²]: legs in antiphase, without a reference gait."""
    return env.flexion_rates(state).sum(-1).square()


def stride(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """(r - 1)² with r² = (d / a)² + (d' / (a ω))², where d is the angle between both hips' flexions and d' its rate.

    It is zero if the legs swing against each other like a pendulum of the angle a and frequency ω of people at 1.25 m/s
    (with the clock, at the target speed), in any phase; quick small steps are penalised at each turning point.
    """
    target = env.target
    amplitude: float | Tensor = _STRIDE
    turn: float | Tensor = math.tau * _CADENCE / 120.0
    if env.config.clock and isinstance(target, Tensor):
        pace = env.reference.pace
        amplitude = pace.hip_swing(target, _LEG_LENGTH)[:, None]
        turn = math.tau * pace.strides_per_second(target)
    return costs.stride_error(state.qpos[:, env.flexion_qpos], env.flexion_rates(state), amplitude, turn)


def metabolic(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Metabolic power of all muscles per kg of body mass, without that of rest [W/kg]; walking people have about 3. The
    model is that of Bhargava et al. 2004 (`msk_ray/legs/metabolic.py`)."""
    return env.metabolic_power(state, action) / env.mass


def head(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Squared speed of the head up and to the side [m²/s²]; it moves with pelvis and trunk, 0.65 m above the pelvis."""
    root = env.root(state)
    velocity = root.velocity + _HEAD_LEVER * torch.linalg.cross(root.spin, root.up)
    return velocity[:, 1:].square().sum(-1)


def impact(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Squared downward speed of heels and toes close to the ground [m²/s²]. (Contact forces carry no gradient.)"""
    feet = env.foot_motion(state)
    return costs.impact(feet.height, feet.rise)


def footfall(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Speed of heel and toes while the clock wants them on the ground: in people the heel is down until 40 % of the
    cycle, the toes from 10 to 60 %."""
    return env.foot_motion(state).sliding(env.leg_phase())


def clearance(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """((clearance_height - height) / clearance_height)² of heel and toes below that height while the clock wants the
    foot in the air."""
    return env.foot_motion(state).dragging(env.leg_phase(), env.config.reward.clearance_height)


def toes(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Angle of the toes from level while the clock wants them on the ground, and from straight otherwise, linear beyond
    0.15 rad. Without it they stay lifted, and the foot has no lever for the end of the push-off."""
    right, (slope, bend) = env.leg_phase(), env.feet.toes(env.frames(state))
    left = right + 0.5
    return costs.lifted_toes(right, slope[:, 0], bend[:, 0]) + costs.lifted_toes(left, slope[:, 1], bend[:, 1])


def vault(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """√(1 + (Δv / 0.1 m/s)²) - 1, where Δv is how far the pelvis's vertical velocity is from that of a body that vaults
    over each leg: lowest in the middle of double support, highest half a step later, by as much as people's centre of
    mass rises at that speed. It decides when feet push off."""
    rise = env.reference.pace.vault(env.leg_phase(), env.task_speed())
    return costs.vaulting(env.root(state).velocity[:, 2], rise)


def out_of_plane(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """√(1 + mean (q / 0.15 rad)²) - 1 of hip adduction, hip rotation and subtalar angle q, as far as the model has
    them: joints that turn people's legs out of the plane they walk in, by less than 10° either way."""
    return costs.out_of_plane(state.qpos[:, env.sideways_qpos])


def track(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """√(1 + mean (Δq / 0.15 rad)²) - 1, where Δq is how far hip flexion, knee and ankle of both legs are from the
    mean of people at the clock's phase."""
    angles, _ = env.reference(env.leg_phase(), env.task_speed())
    return costs.deviation(state.qpos[:, env.track_qpos], angles, _TRACK)


def track_rate(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """The same for their rates, with 2 rad/s."""
    _, rates = env.reference(env.leg_phase(), env.task_speed())
    return costs.deviation(state.qvel[:, env.track_dofs], rates, _TRACK_RATE)


def landing(env: LegEnv[Any], state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """√(1 + (h / 2 mm)²) - 1, where h is how far a heel is above its place in standing, from 4 % of the cycle before
    the clock wants it to strike to 12 % after. Without it a heel may hover a few millimetres above the ground, slowly
    enough for `footfall`, and land late."""
    return env.foot_motion(state).hovering(env.leg_phase())
