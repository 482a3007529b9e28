"""Gradients of a Simulation's step at given states, in tangent coordinates.

Axes: W worlds, R = 2 nv + na rows, the tangent of (qpos', qvel', act').
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from msk_ray.gradcheck.oracle import INPUTS, Array, Point
from msk_ray.simulation import Simulation
from msk_ray.simulation.backward import StepState


def _stack(sim: Simulation, points: Sequence[Point], name: str) -> Tensor:
    rows = np.stack([getattr(point, name) for point in points])
    return torch.as_tensor(rows, dtype=torch.float32, device=sim.device).requires_grad_()


def _numpy(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy().astype(np.float64)


def simulated_gradients(
    sim: Simulation, points: Sequence[Point], cotangents: Array
) -> tuple[list[Point], dict[str, Array]]:
    """Results of one env step of `sim` from W points, and gradients of ⟨cotangent, results⟩ in tangent coordinates.

    Args:
        points: one per world.
        cotangents: tangent cotangents of (qpos', qvel', act'), shape (W, R).

    Returns:
        The results, and by input the gradients, shape (W, columns of that input).
    """
    inputs = {name: _stack(sim, points, name) for name in INPUTS}
    end = sim.step(**inputs)
    weights = torch.as_tensor(cotangents, dtype=torch.float32, device=sim.device)
    on_qpos, on_qvel, on_act = weights.split([sim.model.nv, sim.model.nv, sim.model.na], dim=1)
    raw = StepState(sim.tangent.lift(end.qpos.detach(), on_qpos), on_qvel, on_act)
    gradients = dict(zip(inputs, torch.autograd.grad(end, list(inputs.values()), list(raw)), strict=True))
    gradients["qpos"] = sim.tangent.project(inputs["qpos"].detach(), gradients["qpos"])
    arrays = [_numpy(value) for value in end]
    ends = [Point(point.ctrl, *(array[w] for array in arrays)) for w, point in enumerate(points)]
    return ends, {name: _numpy(value) for name, value in gradients.items()}
