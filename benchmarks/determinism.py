"""Which stages of a step a GPU repeats bit for bit, with which of mujoco_warp's options, and what repeating costs.

Three tables a model and number of worlds. *Stages*: each stage of mujoco_warp's step, of the step with a fixed order
(`msk_ray.step.forward.ordered`) and of the adjoint runs again and again from one and the same input, and every array it
leaves is compared by its bits. *Runs*: how many worlds differ after some steps from one state, and the step that they
first differ in, for each subset of the options. *Cost*: milliseconds a step, replayed from a graph. On a CPU everything
is equal.
"""

import argparse
import copy
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from record import RESULTS, markdown_table, publish
from torch import Tensor

import msk_ray
from msk_ray.config import load_config
from msk_ray.envs import make_env
from msk_ray.step import TapePerSubstep
from msk_ray.step.forward import Graph, Kernels, WorldBatch
from msk_ray.step.forward.ordered.solve import solve
from msk_ray.step.forward.ordered.stages import OrderedStages, with_options

CONFIGS = Path(msk_ray.__file__).resolve().parents[1] / "configs"
MODELS = {
    "cartpole": "cartpole.yaml",
    "ant_matched": "ant.yaml",
    "ant_hard_friction": "ant_hard_friction.yaml",
    "ant_published": "ant_published.yaml",
    "myoleg26": "myoleg26.yaml",
}
FLAGS = {
    "none": mjw.DeterminismType.NONE,
    "contacts": mjw.DeterminismType.CONTACTS,
    "constraint": mjw.DeterminismType.CONSTRAINT,
    "atomics": mjw.DeterminismType.ATOMICS,
    "all": mjw.DeterminismType.ALL,
}
BEGIN = time.perf_counter()
ITERATIONS = 20
"""Newton iterations of steps without conditional graph nodes."""

Launch = Callable[[], None]
Bits = dict[str, Tensor]


def arrays_of(holder: Any, prefix: str = "") -> dict[str, wp.array]:
    """Arrays reachable from a dataclass or a Warp struct, by path."""
    found: dict[str, wp.array] = {}
    if dataclasses.is_dataclass(holder):
        names = [field.name for field in dataclasses.fields(holder)]
    else:
        names = list(holder._cls.vars)
    for name in names:
        value = getattr(holder, name)
        if isinstance(value, wp.array):
            if value.size:
                found[prefix + name] = value
        elif dataclasses.is_dataclass(value):
            found |= arrays_of(value, f"{prefix}{name}.")
    return found


def bits_of(arrays: dict[str, wp.array]) -> Bits:
    """The bytes of every array, on its device; a row for each element of its first axis; waits for what runs."""
    wp.synchronize()
    found = {}
    for name, array in arrays.items():
        tensor = wp.to_torch(array, requires_grad=False).clone(memory_format=torch.contiguous_format)
        found[name] = tensor.reshape(array.shape[0], -1).view(torch.uint8)
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return found


class Kept:
    """Contents of arrays, kept on the device."""

    def __init__(self, arrays: dict[str, wp.array]) -> None:
        self._pairs = [(a, wp.clone(a)) for a in arrays.values()]

    def restore(self) -> None:
        """Put them back."""
        for array, kept in self._pairs:
            wp.copy(array, kept)


def used(name: str, bits: Tensor, data: Any) -> Tensor:
    """The part of an array that is in use: contacts and rows beyond the counts are leftovers."""
    if name.startswith("contact."):
        return bits[: min(int(data.nacon.numpy()[0]), data.naconmax)]
    if name.startswith("efc."):
        array = getattr(data.efc, name.removeprefix("efc."))
        if array.ndim > 1 and array.shape[1] >= data.njmax:
            counts = wp.to_torch(data.nefc).clamp(max=data.njmax)
            rows = torch.arange(array.shape[1], device=bits.device)[None] < counts[:, None]
            return (bits.view(*array.shape[:2], -1) * rows[..., None]).view(len(bits), -1)
    return bits


def differing(first: Bits, second: Bits) -> dict[str, int]:
    """Rows that differ, of every array that does."""
    found = {}
    for name, bits in first.items():
        if len(bits) != len(second[name]):
            found[name] = max(len(bits), len(second[name]))
        elif rows := int((bits != second[name]).any(1).sum()):
            found[name] = rows
    return found


def stages_of(batch: WorldBatch, flags: int) -> list[tuple[str, Launch]]:
    """mujoco_warp's stages, with these flags, and ours where the batch is ordered."""
    model, data = _with_flags(batch.model, flags), batch.data
    end = mjw.euler if model.opt.integrator == mjw.IntegratorType.EULER else mjw.implicit
    found: list[tuple[str, Launch]] = [
        ("kinematics", lambda: mjw.fwd_kinematics(model, data)),
        ("inertia", lambda: mjw.crb(model, data)),
        ("collision", lambda: mjw.collision(model, data)),
        ("constraint rows", lambda: mjw.make_constraint(model, data)),
    ]
    if isinstance(batch.stages, OrderedStages) and data.njmax:
        ordered = batch.stages
        found.append(("our sort of rows", lambda: ordered.sort_rows(data)))
    found += [
        ("transmission", lambda: mjw.transmission(model, data)),
        ("velocity", lambda: mjw.fwd_velocity(model, data)),
        ("actuation", lambda: mjw.fwd_actuation(model, data)),
        ("acceleration", lambda: mjw.fwd_acceleration(model, data, factorize=True)),
        ("solver", lambda: mjw.solve(model, data)),
    ]
    if batch.ordered:
        found[-1] = ("our solver", lambda: solve(model, data))
    return [*found, ("integration", lambda: end(model, data))]


def _with_flags(model: Any, flags: int, **options: Any) -> Any:
    changed = with_options(model, **options)
    object.__setattr__(changed.opt, "_deterministic", int(flags))
    return changed


def run_stages(batch: WorldBatch, flags: int, start: Launch, repeats: int) -> list[list[str]]:
    """A row a stage: what differs between repeats from the same input."""
    data = batch.data
    rows = []
    start()
    for name, launch in stages_of(batch, flags):
        arrays = arrays_of(data)
        before = Kept(arrays)
        worst: dict[str, int] = {}
        first: Bits = {}
        for k in range(repeats):
            before.restore()
            launch()
            found = {n: used(n, b, data) for n, b in bits_of(arrays).items()}
            if k == 0:
                first = found
                continue
            for array, count in differing(first, found).items():
                worst[array] = max(worst.get(array, 0), count)
        rows.append([name, _said(worst)])
    return rows


def run_adjoint(batch: WorldBatch, start: Launch, repeats: int) -> list[list[str]]:
    """A row a group of the adjoint's arrays: what differs between pullbacks of the same substep."""
    tape = TapePerSubstep()
    tape.attach(batch)
    start()
    tape.launch_step(batch)
    work = tape._adjoint.work
    generator = torch.Generator().manual_seed(0)
    cotangents = [torch.randn(view.shape, generator=generator).to(view) for view in tape.cotangent]
    groups = {
        "contact and row laws": work.laws,
        "multipliers": work.multipliers,
        "slopes of dofs": work.slopes,
        "slopes of bodies": work.bars,
        "slopes of tendons": work.tendon_bars,
    }
    results = {"qpos": tape._raw_qpos, "qvel": work.grad_qvel, "act": work.grad_act, "ctrl": work.grad_ctrl}
    arrays = {f"{group}: {n}": a for group, holder in groups.items() for n, a in arrays_of(holder).items()}
    arrays |= {f"gradient: {n}": a for n, a in results.items() if a.size}
    worst: dict[str, int] = {}
    first: Bits = {}
    for k in range(repeats):
        work.grad_ctrl.zero_()
        for view, value in zip(tape.cotangent, cotangents, strict=True):
            view.copy_(value)
        if batch.device.is_cuda:
            torch.cuda.synchronize()
        tape.launch_backward()
        found = bits_of(arrays)
        if k == 0:
            first = found
            continue
        for array, count in differing(first, found).items():
            worst[array] = max(worst.get(array, 0), count)
    names = [*groups, "gradient"]
    return [[f"adjoint, {n}", _said({a: c for a, c in worst.items() if a.startswith(f"{n}:")})] for n in names]


def _said(worst: dict[str, int]) -> str:
    if not worst:
        return "equal"
    ranked = sorted(worst.items(), key=lambda item: -item[1])
    return ", ".join(f"{name} ({count})" for name, count in ranked[:6]) + (", …" if len(ranked) > 6 else "")


def run_steps(batch: WorldBatch, launch: Launch, start: Launch, steps: int, repeats: int) -> tuple[str, str, float]:
    """(worlds that differ in the end, first step in which any did, ms a step) between runs of one recorded step."""
    state = {name: getattr(batch.data, name) for name in ("qpos", "qvel", "act") if getattr(batch.data, name).size}
    graph = Graph(launch, batch.device)
    runs: list[list[Bits]] = []
    for _ in range(2):
        start()
        seen = []
        for _ in range(steps):
            graph.replay()
            seen.append(bits_of(state))
        runs.append(seen)
    first = next((k + 1 for k, (a, b) in enumerate(zip(*runs, strict=True)) if differing(a, b)), 0)
    last = [torch.cat(list(run[-1].values()), dim=1) for run in runs]
    worlds = int((last[0] != last[1]).any(1).sum())
    start()
    wp.synchronize_device(batch.device)
    begin = time.perf_counter()
    for _ in range(repeats):
        graph.replay()
    wp.synchronize_device(batch.device)
    cost = (time.perf_counter() - begin) * 1e3 / repeats
    return f"{worlds} of {batch.nworld}", f"{first}" if first else "–", cost


class Scene:
    """One model in W worlds, at states of the environment's own resets after some steps under random controls.

    Args:
        name: of `MODELS`.
        worlds: W.
        device: Warp's name.
        settle: substeps before the state that everything starts from.
    """

    def __init__(self, name: str, worlds: int, device: str, settle: int) -> None:
        config = load_config(CONFIGS / MODELS[name])
        env = make_env(config.env, config.physics, worlds, device, seed=0, differentiable=False)
        self.name, self.worlds, self.device, self.mjm = name, worlds, device, env.model
        self._state = {n: getattr(env.state.physics, n).detach().cpu().numpy() for n in ("qpos", "qvel", "act")}
        limits = self.mjm.actuator_ctrlrange
        unit = np.random.default_rng(0).random((worlds, self.mjm.nu))
        self._state["ctrl"] = (limits[:, 0] + unit * (limits[:, 1] - limits[:, 0])).astype(np.float32)
        batch = self.batch(ordered=True)
        self.load(batch)
        for _ in range(settle):
            batch.launch_substep(batch.data, 0)
        self._state |= {n: getattr(batch.data, n).numpy().copy() for n in ("qpos", "qvel", "act", "qacc_warmstart")}

    def batch(self, ordered: bool) -> WorldBatch:
        """A batch of the model."""
        return WorldBatch(self.mjm, self.worlds, 1, self.device, kernels=Kernels(ordered=ordered))

    def load(self, batch: WorldBatch) -> None:
        """Put the state into a batch."""
        batch.data.qacc_warmstart.zero_()
        for name, value in self._state.items():
            if value.size:
                getattr(batch.data, name).assign(value)


def variants(scene: Scene) -> dict[str, tuple[WorldBatch, Launch]]:
    """Steps to compare, by name."""
    package, ordered = scene.batch(ordered=False), scene.batch(ordered=True)
    stages = ordered.stages
    assert isinstance(stages, OrderedStages)

    def stepped(flags: int, **options: Any) -> Launch:
        model = _with_flags(package.model, flags, **options)
        return lambda: mjw.step(model, package.data)

    def sorted_step(flags: int, **options: Any) -> Launch:
        model = _with_flags(ordered.model, flags, **options)

        def launch() -> None:
            mjw.fwd_position(model, ordered.data, factorize=False)
            if ordered.data.njmax:
                stages.sort_rows(ordered.data)
            mjw.fwd_velocity(model, ordered.data)
            mjw.fwd_actuation(model, ordered.data)
            mjw.fwd_acceleration(model, ordered.data, factorize=True)
            mjw.solve(model, ordered.data)
            end = mjw.euler if model.opt.integrator == mjw.IntegratorType.EULER else mjw.implicit
            end(model, ordered.data)

        return launch

    def ours(flags: int) -> Launch:
        chosen = copy.copy(stages)
        chosen._atomic = _with_flags(ordered.model, flags)
        if flags:
            chosen.racing = frozenset(("inertia", "velocity", "actuation", "acceleration", "integration"))
        return lambda: chosen.step(ordered.model, ordered.data)

    fixed = {"graph_conditional": False, "iterations": min(ITERATIONS, int(package.model.opt.iterations))}
    return {
        "package": (package, stepped(0)),
        "ordered": (ordered, lambda: stages.step(ordered.model, ordered.data)),
        "ordered, flag none": (ordered, ours(FLAGS["none"])),
        "ordered, flag atomics": (ordered, ours(FLAGS["atomics"])),
        "sorted contacts and rows": (ordered, sorted_step(0)),
        "package, fixed iterations": (package, stepped(0, **fixed)),
        "package, flag contacts": (package, stepped(FLAGS["contacts"], **fixed)),
        "package, flag constraint": (package, stepped(FLAGS["constraint"], **fixed)),
        "package, flag atomics": (package, stepped(FLAGS["atomics"], **fixed)),
        "package, flag all": (package, stepped(FLAGS["all"], **fixed)),
        "sorted, flag atomics": (ordered, sorted_step(FLAGS["atomics"], **fixed)),
    }


def report(scene: Scene, args: argparse.Namespace) -> str:
    """The tables of one model."""
    rows = []
    for name, (batch, launch) in variants(scene).items():
        slow = name in ("package, flag atomics", "package, flag all", "sorted, flag atomics")
        if slow and scene.worlds > args.slow_worlds:
            rows.append([name, "not run", "", ""])
            continue
        worlds, first, cost = run_steps(batch, launch, lambda b=batch: scene.load(b), args.steps, args.replays)
        rows.append([name, worlds, first, f"{cost:.3f}"])
        print(f"{time.perf_counter() - BEGIN:.0f} s", scene.name, scene.worlds, rows[-1], flush=True)
    header = ["step", f"worlds that differ after {args.steps}", "first in step", "ms a step"]
    parts = [markdown_table(header, rows)]
    for ordered, flags in ((True, "none"), (True, "atomics"), (False, "none"), (False, "all")):
        if flags in args.without:
            continue
        batch = scene.batch(ordered)
        begin = lambda b=batch: scene.load(b)  # noqa: E731
        rows = run_stages(batch, FLAGS[flags], begin, args.repeats)
        if flags == "none":
            rows += run_adjoint(batch, begin, args.repeats)
        said = "the step in a fixed order" if ordered else "mujoco_warp's step"
        table = markdown_table(["stage", "arrays that differ, and rows of them"], rows)
        parts.append(f"{said}, flags {flags}:\n\n{table}")
        print(f"{time.perf_counter() - BEGIN:.0f} s", scene.name, scene.worlds, parts[-1], flush=True)
    return "\n\n".join(parts)


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--models", nargs="+", choices=sorted(MODELS), default=list(MODELS))
    p.add_argument("--worlds", type=int, nargs="+", default=[4096])
    p.add_argument("--settle", type=int, default=60, help="substeps before the state that everything starts from")
    p.add_argument("--repeats", type=int, default=6, help="times a stage runs from the same input")
    p.add_argument("--steps", type=int, default=50, help="substeps of a run")
    p.add_argument("--replays", type=int, default=20, help="substeps that are timed")
    p.add_argument("--slow-worlds", type=int, default=512, help="most worlds for steps that take 100 times as long")
    p.add_argument("--without", nargs="+", choices=["none", "atomics", "all"], default=[], help="flags of stages")
    p.add_argument("--device", default="cuda:0" if wp.is_cuda_available() else "cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the tables are appended in")
    args = p.parse_args()
    for name in args.models:
        for worlds in args.worlds:
            scene = Scene(name, worlds, args.device, args.settle)
            kind = mujoco.mjtCone(scene.mjm.opt.cone).name.removeprefix("mjCONE_").lower()
            title = f"What repeats bit for bit: {name} ({kind}, nv {scene.mjm.nv}), {worlds} worlds"
            with wp.ScopedDevice(args.device):
                publish("determinism", title, args.device, report(scene, args), args.results)


if __name__ == "__main__":
    main()
