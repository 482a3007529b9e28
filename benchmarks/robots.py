"""Time of an env step of the robots, forward and with its gradient, by solver and backward mode.

    python benchmarks/robots.py                                        # Go1 with 8192 worlds, G1 with 4096: 2 minutes
    python benchmarks/robots.py --worlds 4 --device cpu --steps 1      # a try

An env step is four steps of 5 ms. The worlds begin after 15 env steps under random targets about the first keyframe;
the same step is then repeated, and medians of three rounds are shown. Limits of the solver's iterations are those that
let it converge.
"""

import argparse
import warnings
from importlib.resources import files
from pathlib import Path

import mujoco
import torch
from clock import milliseconds
from record import RESULTS, markdown_table, publish
from torch import Tensor

from msk_ray.step import Simulation
from msk_ray.step.forward import Kernels

WORLDS = {"go1": 8192, "g1": 4096}
SUBSTEPS = 4
DRAWN = 512
"""Worlds that are simulated for the start; the others repeat them."""
VARIANTS = {
    "mujoco_warp": (Kernels(), "tape_per_substep"),
    "fused": (Kernels(fused_solver=True), "tape_per_substep"),
    "fused, tape_all": (Kernels(fused_solver=True), "tape_all"),
}


def scene(robot: str) -> mujoco.MjModel:
    """The robot on flat ground."""
    return mujoco.MjModel.from_xml_string((files("msk_ray.robots") / "scenes" / f"{robot}_flat.xml").read_text())


def start(model: mujoco.MjModel, worlds: int, device: str) -> list[Tensor]:
    """(ctrl, qpos, qvel, act), where the robots stagger."""
    few = min(worlds, DRAWN)
    sim = Simulation(model, few, SUBSTEPS, None, device)
    draws = torch.Generator().manual_seed(0)
    state, middle = sim.initial_state(), torch.tensor(model.key_ctrl[0], dtype=torch.float32)
    ctrl = middle.repeat(few, 1).to(sim.device)
    for _ in range(15):
        ctrl = (middle + 0.3 * torch.randn(few, model.nu, generator=draws)).to(sim.device)
        state = sim.step(ctrl, *state)
    return [part.repeat(-(-worlds // few), 1)[:worlds].contiguous() for part in (ctrl, *state)]


def measure(robot: str, variant: str, inputs: list[Tensor], args: argparse.Namespace) -> list[str]:
    """A row: the times of a step, and env steps per second with the gradient."""
    kernels, backward = VARIANTS[variant]
    sim = Simulation(scene(robot), len(inputs[0]), SUBSTEPS, backward, args.device, kernels=kernels)

    def forward() -> None:
        with torch.no_grad():
            sim.step(*inputs)

    def with_gradient() -> None:
        leaves = [part.clone().requires_grad_() for part in inputs]
        end = sim.step(*leaves)
        (end.qpos.sum() + end.qvel.sum()).backward()

    times = [milliseconds(step, sim.device, args.steps) for step in (forward, with_gradient)]
    return [robot, str(sim.nworld), variant, *(f"{t:.2f}" for t in times), f"{1e3 * sim.nworld / times[1]:,.0f}"]


def main() -> None:
    """Measure, print and append the table to the results."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--robots", nargs="+", choices=list(WORLDS), default=list(WORLDS))
    p.add_argument("--worlds", type=int, help="default: 8192 for Go1, 4096 for G1")
    p.add_argument("--device", default="cuda:0")
    p.add_argument("--steps", type=int, default=20, help="env steps of a round")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    warnings.simplefilter("ignore")  # that the solver may run longer than the scenes say
    rows = []
    for robot in args.robots:
        inputs = start(scene(robot), args.worlds or WORLDS[robot], args.device)
        for variant in VARIANTS:
            rows.append(measure(robot, variant, inputs, args))
            print(*rows[-1], flush=True)
    head = ["robot", "worlds", "solver, tape", "forward ms", "with gradient ms", "env steps/s with gradient"]
    publish("robots", "Env step of the robots", args.device, markdown_table(head, rows), args.results)


if __name__ == "__main__":
    main()
