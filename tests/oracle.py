"""Float64 central differences of C MuJoCo in tangent space: the oracle that gradients are tested against."""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from msk_ray.step import Simulation
from msk_ray.step.autograd.backward import Backward, StepState

INPUTS = ("ctrl", "qpos", "qvel", "act")


def tighten(model: mujoco.MjModel) -> mujoco.MjModel:
    """Solver settings at which differences of 1e-6 are meaningful."""
    model.opt.tolerance = 1e-14
    model.opt.iterations = 200
    model.opt.ls_iterations = 100
    model.opt.ls_tolerance = 1e-6
    return model


@dataclass
class Point:
    """One state and control, float64."""

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray


def rollout(model: mujoco.MjModel, point: Point, substeps: int) -> mujoco.MjData:
    """State after `substeps` steps; the solver starts cold, as in the simulation."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = point.qpos, point.qvel, point.act, point.ctrl
    for _ in range(substeps):
        mujoco.mj_step(model, data)
    return data


def shifted(model: mujoco.MjModel, point: Point, name: str, index: int, amount: float) -> Point:
    """`point` moved along one tangent coordinate."""
    values = {n: np.array(getattr(point, n)) for n in INPUTS}
    if name == "qpos":
        delta = np.zeros(model.nv)
        delta[index] = amount
        mujoco.mj_integratePos(model, values["qpos"], delta, 1.0)
    else:
        values[name][index] += amount
    return Point(**values)


def differences(
    model: mujoco.MjModel, point: Point, substeps: int, weights: dict[str, np.ndarray], eps: float = 1e-6
) -> tuple[dict[str, np.ndarray], float]:
    """Gradient of ⟨weights, end⟩ by input, and the largest relative gap of one-sided slopes (a kink's mark)."""
    end = rollout(model, point, substeps)

    def score(moved: Point) -> float:
        data = rollout(model, moved, substeps)
        change = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, change, 1.0, end.qpos, data.qpos)
        total = change @ weights["qpos"] + (data.qvel - end.qvel) @ weights["qvel"]
        return float(total + (data.act - end.act) @ weights["act"])

    sizes = {"ctrl": model.nu, "qpos": model.nv, "qvel": model.nv, "act": model.na}
    gradients: dict[str, np.ndarray] = {}
    kink = 0.0
    for name in INPUTS:
        plus = np.array([score(shifted(model, point, name, i, eps)) for i in range(sizes[name])])
        minus = np.array([score(shifted(model, point, name, i, -eps)) for i in range(sizes[name])])
        gradients[name] = (plus - minus) / (2 * eps)
        if sizes[name]:
            scale = np.linalg.norm(gradients[name]) + 1e-9
            kink = max(kink, float(np.linalg.norm(plus + minus) / eps / scale))
    return gradients, kink


def simulate(
    model: mujoco.MjModel, mode: Backward, points: list[Point], substeps: int, weights: dict[str, np.ndarray]
) -> tuple[StepState, dict[str, np.ndarray], Simulation]:
    """End states and tangent gradients by `mode`, one world a point; weights have shape (W, n)."""
    sim = Simulation(model, len(points), substeps, mode, "cpu", tolerance=1e-12)
    inputs = {
        n: torch.tensor(np.stack([getattr(p, n) for p in points]), dtype=torch.float32, requires_grad=True)
        for n in INPUTS
    }
    end = sim.step(*(inputs[n] for n in INPUTS))
    cotangent = {n: torch.tensor(weights[n], dtype=torch.float32) for n in ("qpos", "qvel", "act")}
    loss = (end.qvel * cotangent["qvel"]).sum() + (end.act * cotangent["act"]).sum()
    loss = loss + (end.qpos * sim.tangent.lift(end.qpos.detach(), cotangent["qpos"])).sum()
    grads = torch.autograd.grad(loss, [inputs[n] for n in INPUTS], allow_unused=True)
    out = {n: g.numpy().astype(float) for n, g in zip(INPUTS, grads, strict=True)}
    tangent = sim.tangent.project(inputs["qpos"].detach(), grads[1])
    out["qpos"] = tangent.numpy().astype(float)
    return end, out, sim


def relative(a: np.ndarray, b: np.ndarray) -> float:
    """|a - b| / |b|, zero where both are empty or zero."""
    size = float(np.linalg.norm(b))
    gap = float(np.linalg.norm(a - b))
    return gap / size if size > 1e-12 else gap
