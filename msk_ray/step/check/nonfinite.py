"""Names the non-finite elements of a step's Jacobian."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from msk_ray.step.autograd import Simulation
from msk_ray.step.check.oracle import INPUTS, Array, Point
from msk_ray.step.check.pullback import simulated_gradients

_SHOWN = 4
"""Largest number of elements named on a line; further ones are counted."""


@dataclass(frozen=True)
class NonFinite:
    """The non-finite elements at one state."""

    state: str
    """Kind of state."""
    world: int
    """Index among the states of that kind."""
    results: tuple[str, ...]
    """Results of the step that are non-finite, or have a non-finite gradient."""
    inputs: tuple[str, ...]
    """Inputs with a non-finite gradient; empty if the step itself is not finite."""

    def __str__(self) -> str:
        where = f"state {self.world} of {self.state}"
        if not self.inputs:
            return f"{where}: the step's {_few(self.results)}"
        return f"{where}: the slope of {_few(self.results)} by {_few(self.inputs)}"


def _few(names: Sequence[str]) -> str:
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def dof_names(model: mujoco.MjModel) -> list[str]:
    """A name for every degree of freedom: its joint's name, and its index within the joint."""
    out = []
    for joint in range(model.njnt):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
        if not name:
            owner = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.jnt_bodyid[joint]))
            name = f"{joint} of body {owner or int(model.jnt_bodyid[joint])}"
        turns = tuple(f" (turn {axis})" for axis in "xyz")
        match model.jnt_type[joint]:
            case mujoco.mjtJoint.mjJNT_FREE:
                parts: tuple[str, ...] = (*(f" ({axis})" for axis in "xyz"), *turns)
            case mujoco.mjtJoint.mjJNT_BALL:
                parts = turns
            case _:
                parts = ("",)
        out += [f"joint {name}{part}" for part in parts]
    return out


def element_names(model: mujoco.MjModel) -> dict[str, list[str]]:
    """A name for every element of each input, qpos in tangent coordinates."""
    actuators = [f"actuator {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, u) or u}" for u in range(model.nu)]
    activations = [""] * model.na
    for u in range(model.nu):
        for k in range(model.actuator_actnum[u]):
            activations[model.actuator_actadr[u] + k] = actuators[u]
    dofs = dof_names(model)
    owners = {"ctrl": actuators, "qpos": dofs, "qvel": dofs, "act": activations}
    return {name: [f"{name} of {owner}" for owner in owners[name]] for name in INPUTS}


def find_nonfinite(
    sim: Simulation, kind: str, world: int, point: Point, end: Point, gradients: dict[str, Array]
) -> NonFinite | None:
    """The non-finite elements of a step's results and gradients; None if all are finite.

    Args:
        kind: kind of state.
        world: index among the states of that kind.
        point: the inputs of the step.
        end: its results in Warp.
        gradients: gradients by input, for some cotangent at this state.
    """
    names = element_names(sim.model)
    parameters = [name for name in gradients if name not in INPUTS]
    names |= {name: [f"{name}[{k}]" for k in range(gradients[name].size)] for name in parameters}
    lost = [
        names[name][k]
        for name, values in (("qpos", _tangent(sim.model, end.qpos)), ("qvel", end.qvel), ("act", end.act))
        for k in np.flatnonzero(~np.isfinite(values))
    ]
    if lost:
        return NonFinite(kind, world, tuple(lost), ())
    if all(np.all(np.isfinite(gradient)) for gradient in gradients.values()):
        return None
    rows = [*names["qpos"], *names["qvel"], *names["act"]]
    results = set()
    inputs = {(name, int(k)) for name, g in gradients.items() for k in np.flatnonzero(~np.isfinite(g))}
    # One row of the Jacobian per world.
    for first in range(0, len(rows), sim.nworld):
        cotangents = np.zeros((sim.nworld, len(rows)))
        count = min(sim.nworld, len(rows) - first)
        cotangents[np.arange(count), first + np.arange(count)] = 1.0
        _, jacobian = simulated_gradients(sim, [point] * sim.nworld, cotangents, parameters)
        results |= {
            first + k for k in range(count) if not all(np.all(np.isfinite(block[k])) for block in jacobian.values())
        }
    return NonFinite(
        kind,
        world,
        tuple(rows[k] for k in sorted(results)) or ("the weighted sum of all results",),
        tuple(names[name][k] for name in gradients for k in range(len(names[name])) if (name, k) in inputs),
    )


def _tangent(model: mujoco.MjModel, qpos: Array) -> Array:
    """NaN at each degree of freedom of a joint whose coordinates are not all finite, else zero; shape (nv,)."""
    out = np.zeros(model.nv)
    for joint in range(model.njnt):
        ends = (model.jnt_qposadr[joint + 1], model.jnt_dofadr[joint + 1]) if joint + 1 < model.njnt else (None, None)
        if not np.all(np.isfinite(qpos[model.jnt_qposadr[joint] : ends[0]])):
            out[model.jnt_dofadr[joint] : ends[1]] = np.nan
    return out
