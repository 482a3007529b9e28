"""Swing a double pendulum up with a cart: trajectory optimisation by iLQR on the batched Jacobians of the step.

    python docs/examples/ilqr.py ilqr.png

Every iteration linearizes the whole trajectory in one call, with one world per point in time, and tries all step sizes
of the line search in one rollout, with one world per step size.
"""

import argparse
import math

import matplotlib.pyplot as plt
import mujoco
import torch
from torch import Tensor

from msk_ray.step import Simulation, StepState

MODEL = """
<mujoco><option timestep="0.005"/><worldbody>
  <body><joint name="cart" type="slide" axis="1 0 0" damping="0.1"/><geom type="box" size="0.12 0.06 0.05" mass="1"/>
    <body><joint axis="0 -1 0" damping="0.002"/><geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.2"/>
      <body pos="0 0 -0.4"><joint axis="0 -1 0" damping="0.002"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.2"/>
      </body></body></body></worldbody>
  <actuator><motor joint="cart"/></actuator></mujoco>"""
LINK = 0.4
"""Length of a link [m]."""
GOAL = torch.tensor([0.0, torch.pi, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
"""Cart in the middle, both links up, at rest."""
LAST = torch.diag(torch.tensor([50.0, 500.0, 500.0, 5.0, 20.0, 20.0], dtype=torch.float64))
"""Weights of the squared distance from the goal at the end."""
RUNNING = torch.diag(torch.tensor([0.05, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
"""Weights of the same at every step before."""
EFFORT = 2e-3
"""Weight of the squared force [1/N²]."""
STEP_SIZES = 0.5 ** torch.arange(10, dtype=torch.float64)


def cost(states: Tensor, forces: Tensor) -> Tensor:
    """Costs (N,) of N trajectories: states (T + 1, N, 6), forces (T, N, 1)."""
    error = states - GOAL
    running = (error[:-1] @ RUNNING * error[:-1]).sum((0, 2)) + EFFORT * forces.square().sum((0, 2))
    return running + (error[-1] @ LAST * error[-1]).sum(-1)


def rollout(sim: Simulation, states: Tensor, forces: Tensor, gains: Tensor, changes: Tensor) -> tuple[Tensor, Tensor]:
    """Follow u = û + α k + K (x - x̂) with every step size α at once.

    Args:
        sim: as many worlds as step sizes.
        states, forces: the last trajectory x̂ (T + 1, 6) and û (T, 1).
        gains, changes: K (T, 1, 6) and k (T, 1).

    Returns:
        States (T + 1, N, 6) and forces (T, N, 1).
    """
    now = states[0].expand(sim.nworld, -1)
    reached, used = [now], []
    for x, u, gain, change in zip(states[:-1], forces, gains, changes, strict=True):
        force = u + STEP_SIZES[:, None] * change + (now - x) @ gain.T
        end = sim.step(force.float(), *as_state(now))
        now = torch.cat((end.qpos, end.qvel), -1).double()
        reached.append(now)
        used.append(force)
    return torch.stack(reached), torch.stack(used)


def as_state(x: Tensor) -> StepState:
    """States (N, 6) as a simulation takes them."""
    return StepState(*x.float().split(3, dim=-1), torch.zeros(len(x), 0))


def riccati(a: Tensor, b: Tensor, states: Tensor, forces: Tensor, damping: float) -> tuple[Tensor, Tensor]:
    """Gains K (T, 1, 6) and changes k (T, 1) that are best for the linearized trajectory."""
    slope, bend = 2.0 * LAST @ (states[-1] - GOAL), 2.0 * LAST
    gains, changes = [], []
    for t in reversed(range(len(forces))):
        q_x = 2.0 * RUNNING @ (states[t] - GOAL) + a[t].T @ slope
        q_u = 2.0 * EFFORT * forces[t] + b[t].T @ slope
        q_xx = 2.0 * RUNNING + a[t].T @ bend @ a[t]
        q_ux = b[t].T @ bend @ a[t]
        q_uu = 2.0 * EFFORT * torch.eye(1, dtype=torch.float64) + b[t].T @ bend @ b[t]
        damped = q_uu + damping * torch.eye(1, dtype=torch.float64)
        gain, change = -torch.linalg.solve(damped, q_ux), -torch.linalg.solve(damped, q_u)
        slope = q_x + gain.T @ q_uu @ change + gain.T @ q_u + q_ux.T @ change
        bend = q_xx + gain.T @ q_uu @ gain + gain.T @ q_ux + q_ux.T @ gain
        gains.append(gain)
        changes.append(change)
    return torch.stack(gains[::-1]), torch.stack(changes[::-1])


def draw(states: Tensor, history: list[float], path: str) -> None:
    """The motion, dark at its end, and the cost over the iterations."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), gridspec_kw={"width_ratios": [2, 1]})
    for k, (cart, first, second) in enumerate(states[:, :3].tolist()):
        if k % 4 == 0 or k == len(states) - 1:
            knee = cart + LINK * math.sin(first), -LINK * math.cos(first)
            tip = knee[0] + LINK * math.sin(first + second), knee[1] - LINK * math.cos(first + second)
            color = plt.cm.viridis(1.0 - k / len(states))
            left.plot([cart, knee[0], tip[0]], [0.0, knee[1], tip[1]], "-o", color=color, markersize=3)
    left.set(xlabel="x [m]", ylabel="height [m]", aspect="equal", title="a double pendulum is swung up, every 80 ms")
    right.semilogy(history)
    right.set(xlabel="iteration", ylabel="cost", title="iLQR")
    figure.savefig(path, dpi=110, bbox_inches="tight")


def main() -> None:
    """Optimise and draw."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("picture", nargs="?", default="ilqr.png")
    p.add_argument("--steps", type=int, default=150, help="env steps of 20 ms")
    p.add_argument("--iterations", type=int, default=60)
    args = p.parse_args()
    model = mujoco.MjModel.from_xml_string(MODEL)
    along_time = Simulation(model, args.steps, substeps=4)
    tries = Simulation(model, len(STEP_SIZES), substeps=4, backward=None)
    states = torch.zeros(args.steps + 1, 6, dtype=torch.float64)  # hanging at rest, under no force
    forces = torch.zeros(args.steps, 1, dtype=torch.float64)
    push = torch.ones_like(forces)  # hanging still is an equilibrium, so the first trajectory is another one
    tried, used = rollout(tries, states, forces, torch.zeros(args.steps, 1, 6, dtype=torch.float64), push)
    states, forces = tried[:, 0], used[:, 0]
    history = [float(cost(tried[:, :1], used[:, :1]))]
    best, damping = history[0], 1.0
    for iteration in range(args.iterations):
        a, b, _ = along_time.linearize(forces.float(), *as_state(states[:-1]))
        gains, changes = riccati(a.double(), b.double(), states, forces, damping)
        tried, used = rollout(tries, states, forces, gains, changes)
        costs = cost(tried, used)
        k = int(torch.where(costs.isnan(), torch.inf, costs).argmin())  # a step size too large may diverge
        if costs[k] < best:
            states, forces, best, damping = tried[:, k], used[:, k], float(costs[k]), max(damping / 3.0, 1e-6)
        else:
            damping *= 4.0
        history.append(best)
        if iteration % 10 == 9:
            print(f"iteration {iteration + 1}: cost {best:.3f}, largest force {forces.abs().max():.1f} N")
    error = float((states[-1] - GOAL).abs().max())
    print(f"the end is within {error:.3f} of the goal in every coordinate [m, rad, m/s, rad/s]")
    draw(states, history, args.picture)
    print(f"drawn in {args.picture}")


if __name__ == "__main__":
    main()
