"""The time series that gait analysis needs, computed from an episode's states by C MuJoCo in float64.

Axes: T samples, U muscles.
"""

import copy
import os
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import mujoco.rollout
import numpy as np
import torch
from numpy.typing import NDArray

from msk_ray.envs.legs.gait.people import ALIASES
from msk_ray.envs.legs.metabolic import muscle_masses, total_power
from msk_ray.envs.legs.muscles import MuscleCurves
from msk_ray.errors import ConfigError

Array = NDArray[np.float64]
SIDES = ("r", "l")
CURVES = ("hip_flexion", "knee_flexion", "ankle_dorsiflexion", "vertical_force", "forward_force")
"""Curves over a gait cycle: angles [°], forces [body weights]."""
JOINTS = {"hip_flexion": "hip_flexion", "knee_flexion": "knee_angle", "ankle_dorsiflexion": "ankle_angle"}


@dataclass(frozen=True)
class Episode:
    """One episode. "By side" means a dict with the keys `r` and `l`."""

    timestep: float
    """Time between samples [s]."""
    weight: float
    """Body weight [N]."""
    forward: Array
    """Position of the pelvis along the walking direction [m], shape (T,)."""
    feet: dict[str, Array]
    """Position of each heel along the walking direction [m], by side, each (T,)."""
    curves: dict[str, dict[str, Array]]
    """`CURVES` by name and side, each (T,)."""
    activation: Array
    """Activations, shape (T, U)."""
    muscle_power: Array
    """Power that muscles deliver [W], without the power they absorb, shape (T,)."""
    metabolic_power: Array
    """Metabolic power of muscles [W], without that of rest, shape (T,). Excitation is taken to be the activation."""
    muscles: dict[str, dict[str, Array]]
    """Activations of the muscles of `people.EMG` that the model has, by name and side, each (T,)."""


class Series(NamedTuple):
    """States of one episode, equally spaced in time."""

    qpos: Array
    """Shape (T, nq)."""
    qvel: Array
    """Shape (T, nv)."""
    act: Array
    """Shape (T, na)."""


def at_substeps(model: mujoco.MjModel, states: Series, ctrl: Array, substeps: int) -> Series:
    """States of every physics step: C MuJoCo repeats each env step from its recorded state.

    Nothing drifts, because each env step starts from what was recorded, also after a push between two of them.

    Args:
        model: of the episode, with its physics timestep.
        states: recorded at T env steps.
        ctrl: controls held from each of the first T - 1 states to the next, (T - 1, nu).
        substeps: physics steps per env step.

    Returns:
        (T - 1) substeps + 1 states, `model.opt.timestep` apart, of which each `substeps`-th is a recorded one.

    Raises:
        ValueError: the shapes do not fit, or the model has states beside qpos, qvel and act (plugins, delays).
    """
    count = len(states.qpos) - 1
    if len(ctrl) != count:
        raise ValueError(f"{len(ctrl)} controls for {count} env steps between {count + 1} states")
    parts = (model.nq, model.nv, model.na)
    full = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    if full != 1 + sum(parts):
        raise ValueError("the model has states beside qpos, qvel and act; their values are not recorded")
    if count == 0 or substeps == 1:
        return states
    model = copy.copy(model)
    # A diverged episode stays diverged instead of starting again in the reference pose.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    first = np.concatenate((np.zeros((count, 1)), *(part[:-1] for part in states)), axis=1)
    held = np.repeat(ctrl[:, None], substeps - 1, axis=1)
    threads = [mujoco.MjData(model) for _ in range(os.cpu_count() or 1)]
    later, _ = mujoco.rollout.rollout(model, threads, first, held)
    dense = np.concatenate((first[:, None], later), axis=1)[..., 1:].reshape(count * substeps, -1)
    return Series(
        *(
            np.concatenate((part, last[-1:]))
            for part, last in zip(np.split(dense, np.cumsum(parts)[:-1], axis=1), states, strict=True)
        )
    )


def analyse(model: mujoco.MjModel, qpos: Array, qvel: Array, act: Array, timestep: float) -> Episode:
    """Time series of states (T, nq), (T, nv), (T, na) that are `timestep` [s] apart.

    Raises:
        ConfigError: the model has no legs with the names that the leg environments use.
    """
    check_legs(model)
    axes = world_axes(model)
    angles = {name: _angles(model, joint, qpos) for name, joint in JOINTS.items()}
    owners = {side: _carried_by(model, model.body(f"talus_{side}").id) for side in SIDES}
    pelvis, heels = model.body("pelvis").id, {side: model.body(f"calcn_{side}").id for side in SIDES}
    weight = float(np.linalg.norm(model.opt.gravity) * model.body_subtreemass[0])
    muscles = np.flatnonzero(model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_MUSCLE))
    data = mujoco.MjData(model)
    count = len(qpos)
    feet = {side: np.zeros(count) for side in SIDES}
    forces = {side: np.zeros((count, 3)) for side in SIDES}
    forward, given_power = np.zeros(count), np.zeros(count)
    lengths, rates = np.zeros((count, model.ntendon)), np.zeros((count, model.ntendon))
    for t in range(count):
        data.qpos[:], data.qvel[:], data.act[:] = qpos[t], qvel[t], act[t]
        mujoco.mj_forward(model, data)
        forward[t] = data.xpos[pelvis] @ axes[0]
        lengths[t], rates[t] = data.ten_length, data.ten_velocity
        for side in SIDES:
            feet[side][t] = data.xpos[heels[side]] @ axes[0]
            forces[side][t] = axes @ ground_reaction(model, data, owners[side]) / weight
        # A muscle's force is negative where it pulls, its velocity where it shortens.
        given = data.actuator_force[muscles] * data.actuator_velocity[muscles]
        given_power[t] = np.maximum(given, 0.0).sum()
    curves = dict(angles)
    curves["vertical_force"] = {side: forces[side][:, 2] for side in SIDES}
    curves["forward_force"] = {side: forces[side][:, 0] for side in SIDES}
    heat = metabolic_power(model, act, lengths, rates)
    return Episode(timestep, weight, forward, feet, curves, act, given_power, heat, _activations(model, act))


def metabolic_power(model: mujoco.MjModel, act: Array, lengths: Array, rates: Array) -> Array:
    """Metabolic power of all muscles [W], (T,), with activations (T, U) on paths (T, ntendon) [m], [m/s]."""
    curves = MuscleCurves(model, torch.device("cpu"))
    activation, path, rate = (torch.from_numpy(values).float() for values in (act, lengths, rates))
    masses = muscle_masses(curves.peak, curves.optimum)
    found: Array = total_power(curves, masses, activation, activation, path, rate).double().numpy()
    return found


def _activations(model: mujoco.MjModel, act: Array) -> dict[str, dict[str, Array]]:
    muscles = np.flatnonzero(model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_MUSCLE))
    columns = {model.actuator(int(i)).name: k for k, i in enumerate(muscles)}
    found = {}
    for name, aliases in ALIASES.items():
        known = [alias for alias in aliases if all(f"{alias}_{side}" in columns for side in SIDES)]
        if known:
            found[name] = {side: act[:, columns[f"{known[0]}_{side}"]] for side in SIDES}
    return found


def check_legs(model: mujoco.MjModel) -> None:
    """Raise ConfigError unless a model has the bodies, joints and standing keyframe that measuring a gait needs."""
    try:
        model.key("stand")
        for side in SIDES:
            for body in ("calcn", "toes", "talus"):
                model.body(f"{body}_{side}")
            for joint in JOINTS.values():
                model.joint(f"{joint}_{side}")
        model.body("pelvis")
    except KeyError as error:
        raise ConfigError(f"gait needs a model of two legs, as myoleg26 has: {error.args[0]}") from None


def ground_reaction(model: mujoco.MjModel, data: mujoco.MjData, bodies: frozenset[int]) -> Array:
    """Force of the world on a set of bodies [N], in the world frame, shape (3,)."""
    total, wrench = np.zeros(3), np.zeros(6)
    for k in range(data.ncon):
        first, second = (int(model.geom_bodyid[g]) for g in data.contact.geom[k])
        sign = 1.0 if first == 0 and second in bodies else -1.0 if second == 0 and first in bodies else 0.0
        if sign != 0.0:
            mujoco.mj_contactForce(model, data, k, wrench)
            # The force in the contact's frame acts on the second geom.
            total += sign * data.contact.frame[k].reshape(3, 3).T @ wrench[:3]
    return total


def _carried_by(model: mujoco.MjModel, body: int) -> frozenset[int]:
    """A body and its subtree."""
    found = {body}
    for other in range(body + 1, model.nbody):
        if int(model.body_parentid[other]) in found:
            found.add(other)
    return frozenset(found)


def _angles(model: mujoco.MjModel, joint: str, qpos: Array) -> dict[str, Array]:
    """Angles [°] of a joint by side, each (T,), positive in flexion: knees flex towards the longer end of their
    range."""
    found = {}
    sign = flexion_sign(model, joint)
    for side in SIDES:
        found[side] = sign * np.rad2deg(qpos[:, model.joint(f"{joint}_{side}").qposadr[0]])
    return found


def flexion_sign(model: mujoco.MjModel, joint: str) -> float:
    """1 where a joint's angle grows in flexion, else -1: knees flex towards the longer end of their range."""
    lower, upper = model.joint(f"{joint}_r").range
    return -1.0 if joint == "knee_angle" and abs(lower) > abs(upper) else 1.0


def world_axes(model: mujoco.MjModel) -> Array:
    """Forward (heel to toes of the standing pose, level), left and up (against gravity), rows in the world, (3, 3)."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    mujoco.mj_kinematics(model, data)
    up = -model.opt.gravity / np.linalg.norm(model.opt.gravity)
    feet = sum(data.body(f"toes_{side}").xpos - data.body(f"calcn_{side}").xpos for side in SIDES)
    forward = feet - (feet @ up) * up
    forward = forward / np.linalg.norm(forward)
    return np.stack((forward, np.cross(up, forward), up))
