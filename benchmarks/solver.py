"""Time of an env step and of its constraint solver alone, by the solver's kernels; forward only.

    python benchmarks/solver.py --configs ant ant_published myoleg26 --worlds 64 4096 16384
    python benchmarks/solver.py --configs quadruped --limits own enough --worlds 64 4096  # what convergence costs

Each row starts from worlds that have fallen to the ground under random controls. The env step is recorded as a graph
and replayed from that state; the solver is replayed on what the stages before it left in the first substep. Limits of
the solver's iterations are the model's own, or enough to converge, as a Simulation has them.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from record import RESULTS, markdown_table, publish
from replay import milliseconds
from step_models import quadruped

from msk_ray.config import load_config
from msk_ray.envs.make import env_class
from msk_ray.step.forward import Graph, Kernels, WorldBatch
from msk_ray.step.forward.fused import FusedSolver
from msk_ray.step.forward.ordered.solve import solve as solve_ordered
from msk_ray.step.forward.solver_limits import own_limits

KERNELS = {
    "mujoco_warp": Kernels(),
    "fused": Kernels(fused_solver=True),
    "ordered": Kernels(ordered=True),
    "ordered fused": Kernels(ordered=True, fused_solver=True),
}
STATE = ("qpos", "qvel", "act", "ctrl")
SUBSTEPS = 5
"""Of models that belong to no config."""


def build(name: str) -> tuple[mujoco.MjModel, int]:
    """The model of a config, of an MJCF file or `quadruped`, and its substeps."""
    if name == "quadruped":
        return quadruped(), SUBSTEPS
    if name.endswith(".xml"):
        return mujoco.MjModel.from_xml_path(name), SUBSTEPS
    config = load_config(Path("configs") / f"{name}.yaml")
    mjm = env_class(config.env).build_model(config.env, config.physics)
    return mjm, config.physics.resolve_substeps(config.env.control_timestep)


def fallen(mjm: mujoco.MjModel, worlds: int, substeps: int, device: str, steps: int) -> dict[str, np.ndarray]:
    """States of 64 worlds after some env steps under random controls, repeated for all worlds.

    Controls are at most 1 from zero; with a keyframe, at most 0.3 from the first one's, where the worlds start.
    """
    few = min(worlds, 64)
    batch = WorldBatch(mjm, few, substeps, device, kernels=Kernels(**own_limits(mjm)._asdict()))
    qpos, middle, width = (mjm.key_qpos[0], mjm.key_ctrl[0], 0.3) if mjm.nkey else (mjm.qpos0, 0.0, 1.0)
    rng = np.random.default_rng(0)
    data = batch.data
    with wp.ScopedDevice(batch.device):
        graph = Graph(batch.launch_step, batch.device)
        data.qpos.assign(np.tile(qpos, (few, 1)).astype(np.float32))
        data.qvel.assign(0.3 * rng.normal(size=(few, mjm.nv)).astype(np.float32))
        data.act.zero_()
        for _ in range(steps):
            data.ctrl.assign((middle + width * rng.uniform(-1, 1, size=(few, mjm.nu))).astype(np.float32))
            graph.replay()
        wp.synchronize_device(batch.device)
    batch.raise_losses()
    return {name: np.resize(getattr(data, name).numpy(), (worlds, *getattr(data, name).shape[1:])) for name in STATE}


def measure(
    batch: WorldBatch, start: dict[str, np.ndarray], solve: Callable[..., None], repeats: int
) -> tuple[list[str], np.ndarray]:
    """One row, and the velocities after the env step."""
    device, data = batch.device, batch.data
    with wp.ScopedDevice(device):
        held = {name: wp.array(value, dtype=float) for name, value in start.items()}

        def restore() -> None:
            for name, array in held.items():
                wp.copy(getattr(data, name), array)

        def step() -> None:
            restore()
            batch.launch_step()

        whole = Graph(step, device)
        copies = milliseconds(Graph(restore, device), device, repeats)
        taken = milliseconds(whole, device, repeats) - copies
        iterations = data.solver_niter.numpy().copy()
        rows = float(np.mean(data.nefc.numpy()))
        end = data.qvel.numpy().copy()
        batch.raise_losses()
        restore()
        batch.begin_step()
        mjw.forward(batch.model, data)
        alone = milliseconds(Graph(lambda: solve(batch.model, data), device), device, repeats)
        first = data.solver_niter.numpy().copy()
    row = [f"{taken:.3f}", f"{1e3 * alone:.0f}", f"{rows:.1f}"]
    row += [f"{np.mean(n):.2f} / {np.max(n)}" for n in (first, iterations)]
    return row, end


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--configs", nargs="+", default=["ant"], help="names in configs/, MJCF files, or quadruped")
    p.add_argument("--worlds", type=int, nargs="+", default=[64])
    p.add_argument("--kernels", nargs="+", default=["mujoco_warp", "fused"], choices=list(KERNELS))
    p.add_argument("--limits", nargs="+", default=["own"], choices=("own", "enough"), help="of iterations")
    p.add_argument("--steps", type=int, default=60, help="env steps taken before timing, to land")
    p.add_argument("--repeats", type=int, default=20, help="replays a timing averages over")
    p.add_argument("--device", default="cuda:0" if wp.is_cuda_available() else "cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    header = [
        "worlds",
        "kernels",
        "limits",
        "env step ms",
        "first solve µs",
        "rows",
        "iterations cold",
        "warm",
        "velocities differ",
    ]
    for name in args.configs:
        mjm, substeps = build(name)
        table = []
        for worlds in args.worlds:
            start = fallen(mjm, worlds, substeps, args.device, args.steps)
            wanted = None
            for kind in args.kernels:
                kernels = KERNELS[kind]
                launch = FusedSolver() if kernels.fused_solver else solve_ordered if kernels.ordered else mjw.solve
                for limits in args.limits:
                    kept = own_limits(mjm)._asdict() if limits == "own" else {}
                    batch = WorldBatch(mjm, worlds, substeps, args.device, kernels=kernels._replace(**kept))
                    row, end = measure(batch, start, launch, args.repeats)
                    wanted = end if wanted is None else wanted
                    said = " / ".join(str(limit) for limit in batch.limits)
                    table.append([f"{worlds}", kind, said, *row, f"{np.max(np.abs(end - wanted)):.1e}"])
                    print(name, table[-1], flush=True)
        title = f"Env step of {Path(name).stem} (nv {mjm.nv}, {substeps} substeps) by kernels of the solver"
        publish("solver", title, args.device, markdown_table(header, table), args.results)


if __name__ == "__main__":
    main()
