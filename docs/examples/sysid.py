"""Identify 21 parameters of a servo arm from noisy trajectories, by Gauss-Newton on exact derivatives.

    python docs/examples/sysid.py sysid.png

The sensitivity of a trajectory x(t) to parameters θ follows dx(t+1)/dθ = A dx(t)/dθ + F, where A = ∂x'/∂x and
F = ∂x'/∂θ of every step of every trajectory come from one batch: one world per step, and one pullback for each entry of
the state. Beside it, the same Gauss-Newton iterations take the sensitivities by central differences of whole rollouts,
with two more worlds per parameter and trajectory.
"""

import argparse
import time
from collections.abc import Callable
from typing import NamedTuple

import matplotlib.pyplot as plt
import mujoco
import torch
from torch import Tensor

from msk_ray.step import Simulation, StepState

MODEL = """
<mujoco><option timestep="0.004"/><default><joint damping="1" armature="0.03" frictionloss="1"/>
  <geom contype="0" conaffinity="0"/><position kp="80"/></default>
  <worldbody><body name="base"><joint name="turn" axis="0 0 1"/><geom type="cylinder" size="0.06 0.05" mass="1"/>
    <body name="upper"><joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" size="0.035" fromto="0 0 0 0.3 0 0" mass="1"/>
      <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.25 0 0" mass="0.7"/>
        <body name="hand" pos="0.25 0 0"><joint name="wrist" axis="0 1 0"/>
          <geom type="box" size="0.06 0.03 0.02" pos="0.06 0 0" mass="0.3"/>
  </body></body></body></body></worldbody>
  <actuator><position joint="turn"/><position joint="shoulder"/><position joint="elbow"/><position joint="wrist"/>
  </actuator></mujoco>"""
JOINTS, LINKS = 4, 3
NAMES = [f"{what} {k}" for what in ("damping", "armature", "friction loss") for k in range(JOINTS)]
NAMES += [f"{what} {k}" for what in ("servo gain", "mass", "centre of mass") for k in range(LINKS)]
"""Of every joint, and of every joint or link but the first. One servo gain must be known: the same motion comes from
all forces and masses scaled together."""
NOISE = torch.tensor([5e-3] * JOINTS + [5e-2] * JOINTS)
"""Standard deviation of the measured angles [rad] and velocities [rad/s]."""
SUBSTEPS = 4
DIFFERENCE = 1e-2
"""Displacement of a parameter for central differences, relative to it; float32 rounds away smaller ones."""


class Fit(NamedTuple):
    """How a fit went."""

    theta: Tensor
    """Logarithms of the parameters over the model's, (P,)."""
    seconds: list[float]
    """Time since the start after each iteration [s]."""
    costs: list[float]
    """Mean squared residual, in units of the noise."""


def parameters(model: mujoco.MjModel, theta: Tensor) -> dict[str, Tensor]:
    """Fields of the model whose entries are exp(θ) times its own; θ of shape (N, P), a row per world."""
    own = lambda name: torch.as_tensor(getattr(model, name), dtype=torch.float32)  # noqa: E731
    damping, armature, loss, gain, mass, centre = theta.exp().split([JOINTS] * 3 + [LINKS] * 3, dim=-1)
    gain = torch.cat((torch.ones(len(theta), 1), gain), -1)
    fixed = torch.ones(len(theta), model.nbody - LINKS)
    # A servo pulls with kp (ctrl - q): its gain is stored twice.
    shared = torch.zeros_like(own("actuator_biasprm"))
    shared[:, 1] = own("actuator_biasprm")[:, 1]
    along = torch.tensor([1.0, 0.0, 0.0])
    return {
        "dof_damping": own("dof_damping") * damping,
        "dof_armature": own("dof_armature") * armature,
        "dof_frictionloss": own("dof_frictionloss") * loss,
        "actuator_gainprm": own("actuator_gainprm") * gain[..., None],
        "actuator_biasprm": own("actuator_biasprm") - shared + shared * gain[..., None],
        "body_mass": own("body_mass") * torch.cat((fixed, mass), -1),
        "body_ipos": own("body_ipos") * (1.0 + along * (torch.cat((fixed, centre), -1)[..., None] - 1.0)),
    }


def rollout(sim: Simulation, theta: Tensor, ctrl: Tensor) -> Tensor:
    """States (T, N, 8) under controls (T, N, 4) from rest; θ of shape (N, P)."""
    values = parameters(sim.model, theta)
    state, out = sim.initial_state(), []
    for command in ctrl:
        state = sim.step(command, *state, parameters=values)
        out.append(torch.cat((state.qpos, state.qvel), -1))
    return torch.stack(out)


class Exact:
    """Trajectories and their sensitivities by pullbacks of all steps at once."""

    def __init__(self, model: mujoco.MjModel, ctrl: Tensor) -> None:
        self._ctrl = ctrl
        steps, worlds = ctrl.shape[:2]
        self._rollouts = Simulation(model, worlds, SUBSTEPS, backward=None)
        self._steps = Simulation(model, steps * worlds, SUBSTEPS)

    def __call__(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """States (T, N, 8), and their derivatives by θ (T, N, 8, P)."""
        steps, worlds = self._ctrl.shape[:2]
        states = rollout(self._rollouts, theta.expand(worlds, -1), self._ctrl)
        before = torch.cat((torch.zeros_like(states[:1]), states[:-1])).flatten(0, 1).requires_grad_()
        rows = theta.expand(steps * worlds, -1).clone().requires_grad_()
        start = StepState(*before.split(JOINTS, -1), torch.zeros(len(before), 0))
        end = self._steps.step(self._ctrl.flatten(0, 1), *start, parameters=parameters(self._steps.model, rows))
        after = torch.cat((end.qpos, end.qvel), -1)
        slopes = [torch.autograd.grad(column.sum(), (before, rows), retain_graph=True) for column in after.unbind(-1)]
        a, f = (torch.stack(part, 1).unflatten(0, (steps, worlds)) for part in zip(*slopes, strict=True))
        sensitivity, out = torch.zeros_like(f[0]), []
        for step in range(steps):
            sensitivity = a[step] @ sensitivity + f[step]
            out.append(sensitivity)
        return states, torch.stack(out)


class Differences:
    """Trajectories and their sensitivities by central differences, all displaced ones in one batch of worlds."""

    def __init__(self, model: mujoco.MjModel, ctrl: Tensor) -> None:
        self._ctrl = ctrl
        self._copies = 2 * len(NAMES) + 1
        self._rollouts = Simulation(model, self._copies * ctrl.shape[1], SUBSTEPS, backward=None)

    def __call__(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """As `Exact`."""
        worlds, count = self._ctrl.shape[1], len(NAMES)
        moved = DIFFERENCE * torch.cat((torch.zeros(1, count), torch.eye(count), -torch.eye(count)))
        rows = (theta + moved).repeat_interleave(worlds, 0)
        states = rollout(self._rollouts, rows, self._ctrl.repeat(1, self._copies, 1))
        states = states.unflatten(1, (self._copies, worlds))
        plus, minus = states[:, 1 : 1 + count], states[:, 1 + count :]
        return states[:, 0], ((plus - minus) / (2.0 * DIFFERENCE)).permute(0, 2, 3, 1)


def fit(trajectories: Callable[[Tensor], tuple[Tensor, Tensor]], measured: Tensor, iterations: int) -> Fit:
    """Levenberg-Marquardt on the residual (x - measured) / noise, from the model's own parameters."""
    theta, damping = torch.zeros(len(NAMES)), 1e-2
    begin = time.perf_counter()
    states, slopes = trajectories(theta)
    cost = float(((states - measured) / NOISE).square().mean())
    seconds, costs = [time.perf_counter() - begin], [cost]
    for _ in range(iterations):
        residual = ((states - measured) / NOISE).flatten().double()
        jacobian = (slopes / NOISE[:, None]).flatten(0, 2).double()
        normal = jacobian.T @ jacobian
        change = torch.linalg.solve(normal + damping * torch.diag(normal.diag()), jacobian.T @ residual)
        tried = trajectories((theta - change.float()).clamp(-1.0, 1.0))
        tried_cost = float(((tried[0] - measured) / NOISE).square().mean())
        if tried_cost < cost:
            theta = (theta - change.float()).clamp(-1.0, 1.0)
            (states, slopes), cost, damping = tried, tried_cost, max(0.1 * damping, 1e-6)
        else:
            damping *= 10.0
        seconds.append(time.perf_counter() - begin)
        costs.append(cost)
    return Fit(theta, seconds, costs)


def reached(found: Fit, cost: float) -> float:
    """Time until the cost was as low as `cost` [s]."""
    return next(s for s, c in zip(found.seconds, found.costs, strict=True) if c <= cost)


def draw(fits: dict[str, Fit], truth: Tensor, angles: dict[str, Tensor], path: str) -> None:
    """One joint's angle before and after the fit, the costs over time, and the parameters found."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(15, 4))
    for (label, angle), style in zip(angles.items(), (".", "--", "-"), strict=True):
        left.plot(angle.numpy(), style, label=label, markersize=3)
    left.set(xlabel="step", ylabel="shoulder [rad]", title="one of the trajectories")
    left.legend()
    for label, found in fits.items():
        middle.semilogy(found.seconds, found.costs, "o-", label=label, markersize=3)
        right.plot(found.theta.exp().numpy(), "o", label=label, markersize=4, fillstyle="none")
    middle.set(xlabel="seconds", ylabel="mean squared residual [noise²]", title="Gauss-Newton")
    middle.legend()
    right.plot(truth.exp().numpy(), "k_", markersize=12, label="truth")
    right.set(ylabel="of the model's own", title="parameters")
    right.set_xticks(range(len(NAMES)), NAMES, rotation=90, fontsize=6)
    right.legend()
    figure.savefig(path, dpi=110, bbox_inches="tight")


def main() -> None:
    """Make data, fit twice and draw."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("picture", nargs="?", default="sysid.png")
    p.add_argument("--trajectories", type=int, default=6)
    p.add_argument("--steps", type=int, default=64, help="env steps of 16 ms")
    p.add_argument("--iterations", type=int, default=10)
    args = p.parse_args()
    torch.manual_seed(0)
    model = mujoco.MjModel.from_xml_string(MODEL)
    frequency, phase = 0.3 + 1.2 * torch.rand(args.trajectories, JOINTS), 6.3 * torch.rand(args.trajectories, JOINTS)
    times = 0.016 * torch.arange(args.steps)[:, None, None]
    ctrl = 0.8 * torch.sin(6.3 * frequency * times + phase)
    truth = 0.3 * (2.0 * torch.rand(len(NAMES)) - 1.0)
    source = Simulation(model, args.trajectories, SUBSTEPS, backward=None)
    clean = rollout(source, truth.expand(args.trajectories, -1), ctrl)
    measured = clean + NOISE * torch.randn_like(clean)

    methods = {"exact derivatives": Exact(model, ctrl), "central differences": Differences(model, ctrl)}
    fits = {}
    for label, method in methods.items():
        method(torch.zeros(len(NAMES)))  # records the launches, which is no part of the comparison
        fits[label] = fit(method, measured, args.iterations)
    common = max(found.costs[-1] for found in fits.values())
    for label, found in fits.items():
        error = float((found.theta - truth).abs().max())
        print(
            f"{label}: mean squared residual {found.costs[0]:.1f} to {found.costs[-1]:.4f} noise², {common:.4f} after "
            f"{reached(found, common):.1f} s; largest error of {len(NAMES)} parameters {100 * error:.1f} %"
        )
    fitted = rollout(source, fits["exact derivatives"].theta.expand(args.trajectories, -1), ctrl)
    before = rollout(source, torch.zeros(args.trajectories, len(NAMES)), ctrl)
    angles = {"measured": measured[:, 0, 1], "model": before[:, 0, 1], "fitted": fitted[:, 0, 1]}
    draw(fits, truth, angles, args.picture)
    print(f"drawn in {args.picture}")


if __name__ == "__main__":
    main()
