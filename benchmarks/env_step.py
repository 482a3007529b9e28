"""Time of `Simulation.step` as a user calls it, alone and with its backward pass, and the memory of a GPU that a
simulation and its rollout take; with --against for two checkouts in turn.

Wall time on a GPU, the process's own time on CPU.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import torch
from record import RESULTS, markdown_table, publish, used_bytes
from step_models import MODELS

from msk_ray.step import Simulation, TapePerSubstep


def seconds(sim: Simulation, steps: int, backward: bool) -> float:
    """Duration of one env step [s], of a rollout of `steps` from the reference state."""

    def wait() -> None:
        if sim.device.type == "cuda":
            torch.cuda.synchronize(sim.device)

    ctrl = torch.zeros(sim.nworld, sim.model.nu, device=sim.device, requires_grad=backward)
    state = sim.initial_state()
    wait()
    # On CPU this process does all the work itself, and its own time does not depend on what else runs.
    clock = time.process_time if sim.device.type == "cpu" else time.perf_counter
    begin = clock()
    for _ in range(steps):
        state = sim.step(ctrl, *state)
    if backward:
        state.qvel.sum().backward()
    wait()
    return (clock() - begin) / steps


def measure(name: str, args: argparse.Namespace) -> list[float]:
    """Shortest duration over repeats of a step [ms], of a step with its backward pass, and memory [MiB]."""
    before = used_bytes(torch.device(args.device))
    sim = Simulation(MODELS[name](), args.worlds, args.substeps, TapePerSubstep(), args.device)
    times = []
    for backward in (False, True):
        seconds(sim, args.steps, backward)
        times.append(1e3 * min(seconds(sim, args.steps, backward) for _ in range(args.repeats)))
    return [*times, (used_bytes(sim.device) - before) / 2**20]


def elsewhere(tree: Path, arguments: list[str]) -> dict[str, list[float]]:
    """The same measurement by this script in another process, of the package in `tree`."""
    command = [sys.executable, __file__, *arguments, "--json"]
    # First, so that it wins over a package that is installed or on the path already.
    path = os.pathsep.join(filter(None, (str(tree), os.environ.get("PYTHONPATH"))))
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def compared(args: argparse.Namespace) -> list[list[str]]:
    """Rows of both trees, each the median of rounds taken in turn."""
    trees = {"here": Path(__file__).parents[1], "there": args.against.resolve()}
    arguments = ["--models", *args.models, "--device", args.device]
    for option in ("worlds", "substeps", "steps", "repeats"):
        arguments += [f"--{option}", str(getattr(args, option))]
    rounds: dict[str, list[dict[str, list[float]]]] = {tree: [] for tree in trees}
    for _ in range(args.rounds):
        for tree, path in trees.items():
            rounds[tree].append(elsewhere(path, arguments))
            print(tree, rounds[tree][-1], flush=True)
    rows = []
    for name in args.models:
        here, there = ([statistics.median(r[name][k] for r in rounds[t]) for k in range(3)] for t in trees)
        figures = [f"{value:.3f}" for pair in zip(there[:2], here[:2], strict=True) for value in pair]
        changes = [f"{100 * (h / t - 1):+.1f} %" for h, t in zip(here[:2], there[:2], strict=True)]
        rows.append([name, *figures[:2], changes[0], *figures[2:], changes[1], f"{there[2]:.0f}", f"{here[2]:.0f}"])
    return rows


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--models", nargs="+", choices=sorted(MODELS), default=["cartpole", "ant", "ant_elliptic"])
    p.add_argument("--worlds", type=int, default=64)
    p.add_argument("--substeps", type=int, default=4)
    p.add_argument("--steps", type=int, default=32, help="env steps of a rollout")
    p.add_argument("--repeats", type=int, default=10, help="rollouts, of which the fastest counts")
    p.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    p.add_argument("--against", type=Path, metavar="TREE", help="another checkout to compare with")
    p.add_argument("--rounds", type=int, default=5, help="times each tree is measured (default %(default)s)")
    p.add_argument("--json", action="store_true", help="print one JSON object and publish nothing")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    if args.json:
        print(json.dumps({name: measure(name, args) for name in args.models}))
        return
    if args.against is not None:
        header = ["model", "step, there", "here", "change", "step and backward, there", "here", "change"]
        header += ["MiB, there", "here"]
        rows = compared(args)
    else:
        header = ["model", "step", "step and backward", "MiB"]
        found = {name: measure(name, args) for name in args.models}
        rows = [[name, *(f"{value:.3f}" for value in v[:2]), f"{v[2]:.0f}"] for name, v in found.items()]
    title = f"One env step of {args.substeps} substeps in {args.worlds} worlds [ms]"
    publish("env_step", title, args.device, markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
