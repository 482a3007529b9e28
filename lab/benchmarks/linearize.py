"""Time of `Simulation.linearize`: (A, B) of an env step of every world, by the adjoint and by finite differences."""

import argparse
import time

import torch
from record import RESULTS, markdown_table, publish
from step_models import MODELS

from msk_ray.simulation import Backward, FdJacobian, Simulation, TapePerSubstep


class OneRowAtATime(TapePerSubstep):
    """The adjoint with a backward pass for each row, in the worlds of the step."""

    jacobian = Backward.jacobian


WAYS = {"adjoint": TapePerSubstep, "adjoint, row by row": OneRowAtATime, "finite differences": FdJacobian}


def milliseconds(name: str, mode: Backward, worlds: int, args: argparse.Namespace) -> float:
    """Shortest duration of a call [ms], at states that a few env steps of the model under random controls lead to."""
    sim = Simulation(MODELS[name](), worlds, args.substeps, mode, args.device)
    torch.manual_seed(0)
    state = sim.initial_state()
    for _ in range(args.settle):
        ctrl = 0.5 * (2.0 * torch.rand(worlds, sim.model.nu, device=sim.device) - 1.0)
        state = sim.step(ctrl, *state)
    # On CPU this process does all the work itself, and its own time does not depend on what else runs.
    clock = time.process_time if sim.device.type == "cpu" else time.perf_counter
    times = []
    for _ in range(args.repeats + 1):
        begin = clock()
        found = sim.linearize(ctrl, *state)
        if sim.device.type == "cuda":
            torch.cuda.synchronize(sim.device)
        times.append(clock() - begin)
    assert bool(found.A.isfinite().all())
    return 1e3 * min(times[1:])


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--models", nargs="+", choices=sorted(MODELS), default=["ant_elliptic"])
    p.add_argument("--worlds", type=int, nargs="+", default=[64, 4096])
    p.add_argument("--substeps", type=int, default=4)
    p.add_argument("--settle", type=int, default=30, help="env steps before the states that are linearized")
    p.add_argument("--repeats", type=int, default=10, help="calls, of which the fastest counts")
    p.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    p.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    args = p.parse_args()
    rows = []
    for name in args.models:
        for worlds in args.worlds:
            times = [milliseconds(name, WAYS[way](), worlds, args) for way in args.ways]
            rows.append([name, str(worlds), *(f"{value:.2f}" for value in times)])
            print(rows[-1], flush=True)
    title = f"(A, B) of an env step of {args.substeps} substeps [ms]"
    publish("linearize", title, args.device, markdown_table(["model", "worlds", *args.ways], rows), RESULTS)


if __name__ == "__main__":
    main()
