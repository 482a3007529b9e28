"""The time series that gait analysis needs, computed from an episode's states by C MuJoCo in float64.

Axes: T samples, U muscles.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from mujoco.rollout import rollout
from numpy.typing import NDArray

from msk_ray.errors import ConfigError, SimulationError
from msk_ray.legs.gait.people import ALIASES
from msk_ray.legs.metabolic import muscle_masses, total_power
from msk_ray.legs.muscles import MuscleCurves, muscles_of

Array = NDArray[np.float64]
SIDES = ("r", "l")
CURVES = ("hip_flexion", "knee_flexion", "ankle_dorsiflexion", "vertical_force", "forward_force")
"""Curves over a gait cycle: angles [°], forces [body weights]."""
JOINTS = {"hip_flexion": "hip_flexion", "knee_flexion": "knee_angle", "ankle_dorsiflexion": "ankle_angle"}


class Motion(NamedTuple):
    """States of one episode."""

    qpos: Array
    """Shape (T, nq)."""
    qvel: Array
    """Shape (T, nv)."""
    act: Array
    """Shape (T, na)."""


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


def between(
    model: mujoco.MjModel, recorded: Motion, ctrl: Array, substeps: int, applied: Array | None = None
) -> Motion:
    """The states of an episode at every physics substep, from those at control steps.

    The recorded states are the truth and every `substeps`-th sample: each control step is repeated from the state that
    is recorded at its beginning, so what float32 and float64 make different does not add up.

    Args:
        model: what the episode was simulated with; its timestep is that of a substep.
        recorded: states at the C + 1 ends of C control steps, each as its control step begins with it.
        ctrl: row t acts from state t to state t + 1, the last row on nothing, shape (C + 1, nu).
        substeps: physics steps per control step.
        applied: forces on the degrees of freedom [N, N m], in rows like those of `ctrl`, (C + 1, nv); None for none.

    Returns:
        C * substeps + 1 states, `model.opt.timestep` apart.

    Raises:
        SimulationError: as for `repeated`.
    """
    if substeps == 1 or len(ctrl) == 1:
        return recorded
    inside = repeated(model, recorded, ctrl, substeps, applied)

    def joined(start: Array, after: Array) -> Array:
        samples = np.concatenate((start[:-1, None], after[:, :-1]), axis=1)
        return np.concatenate((samples.reshape(-1, start.shape[1]), start[-1:]))

    return Motion(*(joined(start, after) for start, after in zip(recorded, inside, strict=True)))


def repeated(
    model: mujoco.MjModel, recorded: Motion, ctrl: Array, substeps: int, applied: Array | None = None
) -> Motion:
    """The states after each substep of C control steps, (C, substeps, ·), each control step from its recorded state.

    The last one of a control step is what C MuJoCo has for the next recorded state.

    Args:
        model, recorded, ctrl, substeps, applied: as for `between`.

    Raises:
        SimulationError: C MuJoCo diverged.
    """
    kind = mujoco.mjtState
    threads = [mujoco.MjData(model) for _ in range(torch.get_num_threads())]
    start = np.empty(mujoco.mj_stateSize(model, kind.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, threads[0], start, kind.mjSTATE_FULLPHYSICS)
    # MuJoCo's order: time, qpos, qvel, act.
    ends = np.cumsum([1, model.nq, model.nv, model.na])
    starts = np.tile(start, (len(ctrl) - 1, 1))
    starts[:, 1 : ends[-1]] = np.concatenate([part[:-1] for part in recorded], axis=1)
    inputs, spec = ctrl[:-1], int(kind.mjSTATE_CTRL)
    if applied is not None:
        inputs, spec = np.concatenate((inputs, applied[:-1]), axis=1), spec | int(kind.mjSTATE_QFRC_APPLIED)
    states, _ = rollout(model, threads, starts, inputs[:, None], control_spec=spec, nstep=substeps)
    # Where a state diverges, MuJoCo starts again at time 0, and `rollout` repeats its last row.
    lost = np.flatnonzero(np.abs(states[:, -1, 0] / model.opt.timestep - substeps) > 0.5)
    if len(lost):
        raise SimulationError(
            f"C MuJoCo diverges in control step {lost[0]} of an episode, where the simulator did not: lower "
            "physics.timestep"
        )
    return Motion(*np.split(states[..., : ends[-1]], ends[:-1], axis=-1)[1:])


def analyse(model: mujoco.MjModel, qpos: Array, qvel: Array, act: Array, timestep: float) -> Episode:
    """Time series of states (T, nq), (T, nv), (T, na) that are `timestep` [s] apart.

    Raises:
        ConfigError: the model has no legs with the names that the leg environments use.
    """
    check_legs(model)
    axes = world_axes(model)
    angles = {name: _angles(model, joint, qpos) for name, joint in JOINTS.items()}
    owners = [_carried_by(model, model.body(f"talus_{side}").id) for side in SIDES]
    weight = float(np.linalg.norm(model.opt.gravity) * model.body_subtreemass[0])
    muscles = muscles_of(model)
    bodies = [model.body(name).id for name in ("pelvis", *(f"calcn_{side}" for side in SIDES))]
    data = mujoco.MjData(model)
    count = len(qpos)
    places, forces = np.zeros((count, 3, 3)), np.zeros((count, 2, 3))
    lengths, rates = np.zeros((count, model.ntendon)), np.zeros((count, model.ntendon))
    pulls, speeds = np.zeros((count, model.nu)), np.zeros((count, model.nu))
    # The loop takes most of the time of an analysis: what can be computed for all samples at once is left for later.
    for t in range(count):
        data.qpos, data.qvel, data.act = qpos[t], qvel[t], act[t]
        mujoco.mj_forward(model, data)
        places[t] = data.xpos[bodies]
        lengths[t], rates[t] = data.ten_length, data.ten_velocity
        pulls[t], speeds[t] = data.actuator_force, data.actuator_velocity
        forces[t] = ground_reactions(model, data, owners)
    forward, *heels = (places @ axes[0]).T
    forces = forces @ axes.T / weight
    # A muscle's force is negative where it pulls, its velocity where it shortens.
    given_power = np.maximum(pulls[:, muscles] * speeds[:, muscles], 0.0).sum(1)
    curves = dict(angles)
    curves["vertical_force"] = {side: forces[:, k, 2] for k, side in enumerate(SIDES)}
    curves["forward_force"] = {side: forces[:, k, 0] for k, side in enumerate(SIDES)}
    feet = dict(zip(SIDES, heels, strict=True))
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
    columns = {model.actuator(int(i)).name: k for k, i in enumerate(muscles_of(model))}
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


def ground_reactions(model: mujoco.MjModel, data: mujoco.MjData, owners: Sequence[frozenset[int]]) -> Array:
    """Force of the world on each of S sets of bodies [N], in the world frame, shape (S, 3)."""
    total, wrench = np.zeros((len(owners), 3)), np.zeros(6)
    if data.ncon == 0:
        return total
    contact = data.contact
    frames = contact.frame
    for k, (first, second) in enumerate(model.geom_bodyid[contact.geom].tolist()):
        if first != 0 and second != 0:
            continue
        for row, bodies in enumerate(owners):
            sign = 1.0 if first == 0 and second in bodies else -1.0 if second == 0 and first in bodies else 0.0
            if sign != 0.0:
                mujoco.mj_contactForce(model, data, k, wrench)
                # The force in the contact's frame acts on the second geom.
                total[row] += sign * frames[k].reshape(3, 3).T @ wrench[:3]
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
