"""Time of one substep: forward, its adjoint alone, and backward with recompute; and memory, for several models."""

import argparse
from collections.abc import Callable
from pathlib import Path

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from record import RESULTS, markdown_table, publish
from replay import milliseconds
from step_models import MODELS

from msk_ray.errors import UnsupportedModelError
from msk_ray.step import TapeAll, TapePerSubstep
from msk_ray.step.forward import Graph, WorldBatch


def settle(batch: WorldBatch, steps: int) -> dict[str, wp.array]:
    """Run `steps` substeps from the reference pose under small random controls, and return that state."""
    rng = np.random.default_rng(0)
    mjm, data = batch.mjm, batch.data
    data.qpos.assign(np.tile(mjm.qpos0, (batch.nworld, 1)).astype(np.float32))
    data.qvel.assign(0.1 * rng.normal(size=(batch.nworld, mjm.nv)).astype(np.float32))
    data.ctrl.assign(0.3 * rng.uniform(-1, 1, size=(batch.nworld, mjm.nu)).astype(np.float32))
    graph = Graph(lambda: mjw.step(batch.model, data), batch.device)
    data.qpos.assign(np.tile(mjm.qpos0, (batch.nworld, 1)).astype(np.float32))
    data.qvel.assign(0.1 * rng.normal(size=(batch.nworld, mjm.nv)).astype(np.float32))
    if mjm.na:
        data.act.zero_()
    for _ in range(steps):
        graph.replay()
    return {name: wp.clone(getattr(data, name)) for name in ("qpos", "qvel", "act", "ctrl")}


def measure(mjm: mujoco.MjModel, worlds: int, device: str, steps: int, repeats: int) -> list[str]:
    """One row: per-substep forward, adjoint alone, backward with recompute, their shares, contacts and memory."""
    batch = WorldBatch(mjm, worlds, 1, device)
    with wp.ScopedDevice(batch.device):
        state = settle(batch, steps)

        def restored(launches: Callable[[], None]) -> Callable[[], None]:
            def run() -> None:
                for name, array in state.items():
                    wp.copy(getattr(batch.data, name), array)
                launches()

            return run

        copies = milliseconds(Graph(restored(lambda: None), batch.device), batch.device, repeats)
        forward = milliseconds(Graph(restored(batch.launch_step), batch.device), batch.device, repeats) - copies
        tape, whole = TapePerSubstep(), TapeAll()
        for mode in (whole, tape):
            mode.attach(batch)
            # Something to pull back; its size does not matter to the time.
            for view in mode.cotangent:
                view.fill_(1.0)
        Graph(restored(lambda: whole.launch_step(batch)), batch.device).replay()
        adjoint = milliseconds(Graph(whole.launch_backward, batch.device), batch.device, repeats)
        Graph(restored(lambda: tape.launch_step(batch)), batch.device).replay()
        backward = milliseconds(Graph(tape.launch_backward, batch.device), batch.device, repeats)
        contacts = int(batch.data.nacon.numpy()[0]) / worlds
    return [
        f"{worlds}",
        f"{forward:.3f}",
        f"{adjoint:.3f}",
        f"{adjoint / forward:.2f}",
        f"{backward:.3f}",
        f"{backward / forward:.2f}",
        f"{contacts:.1f}",
        f"{tape.bytes_saved() / worlds:.0f}",
        f"{whole.bytes_saved() / worlds:.0f}",
    ]


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--models", nargs="+", choices=sorted(MODELS), default=sorted(MODELS))
    p.add_argument("--worlds", type=int, nargs="+", default=[16, 64])
    p.add_argument("--steps", type=int, default=60, help="substeps taken before timing, to land in contact")
    p.add_argument("--repeats", type=int, default=20, help="replays a timing averages over")
    p.add_argument("--device", default="cuda:0" if wp.is_cuda_available() else "cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    header = [
        *("worlds", "forward ms", "adjoint ms", "of forward", "backward ms", "of forward", "contacts"),
        *("B/world tape_per_substep", "B/world tape_all"),
    ]
    for name in args.models:
        mjm = MODELS[name]()
        rows = []
        for worlds in args.worlds:
            try:
                rows.append(measure(mjm, worlds, args.device, args.steps, args.repeats))
            except UnsupportedModelError as error:
                print(f"{name}: {error}")
                break
            print(name, rows[-1], flush=True)
        if rows:
            title = f"One substep of {name} (nv {mjm.nv}, nu {mjm.nu}), adjoint and backward against forward"
            publish("step", title, args.device, markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
