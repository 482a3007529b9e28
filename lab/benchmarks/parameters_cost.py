"""Cost of gradients of all parameters of a model: time of a step and of its backward pass, and memory.

Wall time on a GPU, the process's own time on CPU. Whether a step without parameters costs what it did before another
change: `python benchmarks/env_step.py --against CHECKOUT`.
"""

import argparse
import time
from pathlib import Path

import mujoco
import torch
from parameters import MODELS
from record import RESULTS, markdown_table, publish, used_bytes
from torch import Tensor

from msk_ray.physics.parameters import PARAMETERS, names_of
from msk_ray.simulation import Simulation


def values_of(model: mujoco.MjModel, names: list[str], worlds: int | None, device: torch.device) -> dict[str, Tensor]:
    """The model's own values, one for all worlds or with a row per world, whose gradients are wanted."""
    values = {n: torch.as_tensor(PARAMETERS[n].value(model), dtype=torch.float32, device=device) for n in names}
    rows = () if worlds is None else (worlds,)
    return {n: v.expand((*rows, *v.shape)).clone().requires_grad_() for n, v in values.items()}


def milliseconds(sim: Simulation, values: dict[str, Tensor], steps: int) -> tuple[float, float]:
    """Duration of a step and of a step's backward pass [ms], of a rollout of `steps` from the reference state."""

    def wait() -> None:
        if sim.device.type == "cuda":
            torch.cuda.synchronize(sim.device)

    clock = time.process_time if sim.device.type == "cpu" else time.perf_counter
    ctrl = torch.zeros(sim.nworld, sim.model.nu, device=sim.device, requires_grad=True)
    state = sim.initial_state()
    wait()
    begin = clock()
    for _ in range(steps):
        state = sim.step(ctrl, *state, parameters=values)
    wait()
    middle = clock()
    state.qvel.sum().backward()
    wait()
    return 1e3 * (middle - begin) / steps, 1e3 * (clock() - middle) / steps


def measure(model: mujoco.MjModel, args: argparse.Namespace) -> list[list[str]]:
    """One row for each way to use parameters."""
    names = names_of(model)
    rows: list[list[str]] = []
    plain = 0.0
    for title, worlds in (("none", 0), ("all, one value", None), ("all, a row per world", args.worlds)):
        device = torch.device(args.device)
        before = used_bytes(device)
        sim = Simulation(model, args.worlds, args.substeps, device=args.device)
        values = {} if worlds == 0 else values_of(model, names, worlds, device)
        milliseconds(sim, values, args.steps)
        times = [milliseconds(sim, values, args.steps) for _ in range(args.repeats)]
        step, back = min(t[0] for t in times), min(t[1] for t in times)
        plain = plain or back
        memory = f"{(used_bytes(device) - before) / 2**20:.0f}" if device.type == "cuda" else "-"
        rows.append([title, f"{step:.3f}", f"{back:.3f}", f"{back / plain:.2f}", memory])
        print(rows[-1], flush=True)
        del sim, values
    return rows


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--model", choices=sorted(MODELS), default="ant", metavar="NAME")
    p.add_argument("--worlds", type=int, default=1024)
    p.add_argument("--substeps", type=int, default=4)
    p.add_argument("--steps", type=int, default=8, help="env steps of a rollout")
    p.add_argument("--repeats", type=int, default=5)
    p.add_argument("--device", default="cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    model = MODELS[args.model]()
    rows = measure(model, args)
    header = ["gradients of parameters", "step, ms", "backward, ms", "of none", "memory, MiB"]
    title = f"{args.model}: cost of gradients of {len(names_of(model))} parameters, {args.worlds} worlds, "
    title += f"{args.substeps} substeps"
    publish("parameters_cost", title, args.device, markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
