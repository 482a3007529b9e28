"""What a robot cannot do in a motion: joints beyond their ranges, parts in the ground or each other, hovering.

Axes: F frames.
"""

from typing import Final

import mujoco
import numpy as np

from msk_ray.robots.tracking.motions import Array, Motion, beyond_range

_RANGE_TOLERANCE: Final = 0.02
"""Largest angle beyond a joint's range that is not reported [rad]."""
_DEPTH_TOLERANCE: Final = 0.03
"""Largest depth in the ground, or in another part of the robot, that is not reported [m]."""
_CONTACT_STRIDE: Final = 5
"""Contacts are looked for in every fifth frame, because that is slow."""
_LIFTED: Final = 0.03
"""A part nearer to the ground than this may carry the robot [m]."""
_SHORTEST_FLIGHT: Final = 0.2
"""Shorter flights say too little about the acceleration [s]."""
_SLOW_FALL: Final = 0.5
"""Share of gravity; who falls more slowly hovers."""


def remarks(motion: Motion, model: mujoco.MjModel) -> list[str]:
    """What is wrong with a motion that can be followed nevertheless, one line for each fault."""
    lines = []
    excess = beyond_range(motion, model)
    if (worst := float(excess.max())) > _RANGE_TOLERANCE:
        joint = int(excess.max(0).argmax())
        share = float((excess > _RANGE_TOLERANCE).any(1).mean())
        lines.append(f"{model.joint(joint + 1).name} up to {worst:.2f} rad beyond its range, any joint in {share:.0%}")
    ground, itself = depths(motion, model).T
    for depth, where in ((ground, "the ground"), (itself, "itself")):
        if (deepest := float(depth.max())) > _DEPTH_TOLERANCE:
            share, tolerance_cm = float((depth > _DEPTH_TOLERANCE).mean()), 100.0 * _DEPTH_TOLERANCE
            lines.append(f"up to {100.0 * deepest:.0f} cm in {where}, over {tolerance_cm:.0f} cm in {share:.0%}")
    if spans := hovering(motion, model):
        start, longest = max(spans, key=lambda span: span[1])
        lines.append(f"hovers for {sum(length for _, length in spans):.1f} s, {longest:.1f} s of it from {start:.1f} s")
    return lines


def depths(motion: Motion, model: mujoco.MjModel) -> Array:
    """Depth of the robot in the ground, and of its parts in each other [m], in every fifth frame, (F / 5, 2)."""
    data = mujoco.MjData(model)
    is_ground = _in_the_world(model)
    deepest = []
    for qpos in motion.qpos[::_CONTACT_STRIDE]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        contact = data.contact
        on_ground = is_ground[contact.geom].any(-1) if data.ncon else np.zeros(0, bool)
        deepest.append([max((0.0, *(-contact.dist[chosen]))) for chosen in (on_ground, ~on_ground)])
    return np.array(deepest)


def hovering(motion: Motion, model: mujoco.MjModel) -> list[tuple[float, float]]:
    """When the robot is in the air but does not fall: start and duration of each such flight [s].

    In a flight no part is within 3 cm of the ground. It counts if it lasts 0.2 s or longer and the centre of mass
    accelerates downwards by less than half of gravity, from the least-squares parabola of its height. Clips of people
    that were made smaller for a robot, but not faster, jump like that.
    """
    height, lifted = _flight(motion, model)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], lifted, [False]))))
    spans = []
    for first, end in edges.reshape(-1, 2):
        seconds = (end - first) / motion.rate
        if seconds >= _SHORTEST_FLIGHT and end - first >= 3:
            times = np.arange(end - first) / motion.rate
            acceleration = np.polynomial.Polynomial.fit(times, height[first:end], 2).deriv(2)(0.0)
            if acceleration > _SLOW_FALL * model.opt.gravity[2]:
                spans.append((first / motion.rate, seconds))
    return spans


def _flight(motion: Motion, model: mujoco.MjModel) -> tuple[Array, np.ndarray]:
    """Height of the centre of mass [m], (F,), and whether no part is near the ground, (F,)."""
    data = mujoco.MjData(model)
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    is_ground = _in_the_world(model)
    pairs = [(part, ground) for ground in np.flatnonzero(is_ground) for part in np.flatnonzero(collides & ~is_ground)]
    height, lifted = np.zeros(len(motion)), np.zeros(len(motion), dtype=bool)
    for frame, qpos in enumerate(motion.qpos):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        height[frame] = data.subtree_com[0, 2]
        nearest = (mujoco.mj_geomDistance(model, data, part, ground, 2.0 * _LIFTED, None) for part, ground in pairs)
        lifted[frame] = all(distance > _LIFTED for distance in nearest)
    return height, lifted


def _in_the_world(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms do not move, a bool for each."""
    return np.asarray(model.body_weldid[model.geom_bodyid] == 0)
