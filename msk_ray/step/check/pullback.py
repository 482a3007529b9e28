"""Gradients of a Simulation's step at given states, in tangent coordinates.

Axes: W worlds, R = 2 nv + na rows, the tangent of (qpos', qvel', act').
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from msk_ray.step.autograd import Simulation
from msk_ray.step.autograd.backward import StepState
from msk_ray.step.autograd.tangent import quat_conjugate, quat_multiply
from msk_ray.step.check.oracle import INPUTS, Array, Point
from msk_ray.step.forward.parameters import PARAMETERS


def _stack(sim: Simulation, points: Sequence[Point], name: str) -> Tensor:
    rows = np.stack([getattr(point, name) for point in points])
    return torch.as_tensor(rows, dtype=torch.float32, device=sim.device).requires_grad_()


def _nominal(sim: Simulation, name: str) -> Tensor:
    """The model's own value of a parameter, one row per world."""
    value = torch.as_tensor(PARAMETERS[name].value(sim.model), dtype=torch.float32, device=sim.device)
    return value.expand(sim.nworld, *value.shape).clone().requires_grad_()


def _columns(name: str, value: Tensor, gradient: Tensor) -> Tensor:
    """A parameter's gradient, one row per world; for quaternions by rotations in the local frame."""
    if PARAMETERS[name].quaternion:
        gradient = 0.5 * quat_multiply(quat_conjugate(value.detach()), gradient)[..., 1:]
    return gradient.reshape(len(gradient), -1)


def _numpy(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy().astype(np.float64)


def simulated_gradients(
    sim: Simulation, points: Sequence[Point], cotangents: Array, parameters: Sequence[str] = ()
) -> tuple[list[Point], dict[str, Array]]:
    """Results of one env step of `sim` from W points, and gradients of ⟨cotangent, results⟩ in tangent coordinates.

    Args:
        points: one per world.
        cotangents: tangent cotangents of (qpos', qvel', act'), shape (W, R).
        parameters: model fields to differentiate by, too, at the model's own values.

    Returns:
        The results, and by input and parameter the gradients, shape (W, columns).
    """
    inputs = {name: _stack(sim, points, name) for name in INPUTS}
    values = {name: _nominal(sim, name) for name in parameters}
    end = sim.step(inputs["ctrl"], inputs["qpos"], inputs["qvel"], inputs["act"], parameters=values)
    weights = torch.as_tensor(cotangents, dtype=torch.float32, device=sim.device)
    on_qpos, on_qvel, on_act = weights.split([sim.model.nv, sim.model.nv, sim.model.na], dim=1)
    raw = StepState(sim.tangent.lift(end.qpos.detach(), on_qpos), on_qvel, on_act)
    leaves = inputs | values
    gradients = dict(zip(leaves, torch.autograd.grad(end, list(leaves.values()), list(raw)), strict=True))
    gradients["qpos"] = sim.tangent.project(inputs["qpos"].detach(), gradients["qpos"])
    gradients |= {name: _columns(name, value, gradients[name]) for name, value in values.items()}
    arrays = [_numpy(value) for value in end]
    ends = [Point(point.ctrl, *(array[w] for array in arrays)) for w, point in enumerate(points)]
    return ends, {name: _numpy(value) for name, value in gradients.items()}
