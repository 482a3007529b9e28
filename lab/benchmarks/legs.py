"""Control steps per second of the muscle-driven legs: forward, and forward with backward, compared with C MuJoCo and
myosuite.

A control step is what the environment does for one action: 20 ms of physics, observation, reward and resets. `recorded`
is forward and backward replayed as one CUDA graph, as training does; it needs `--set execution.solver_kernels=fused`,
because the loop of mujoco_warp's solver cannot be part of such a graph.
"""

import argparse
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import torch
from msk_ray.envs.myoleg.source import find_model
from msk_ray.simulation.capture import Recording
from record import RESULTS, markdown_table, publish

from msk_ray.config import Config, load_config
from msk_ray.envs import make_env
from msk_ray.errors import ConfigError

MODELS = {"myoleg26": ("configs/myoleg26.yaml", "env.assist.epochs=0"), "myolegs": ("configs/myoleg.yaml",)}
ROOT = Path(__file__).resolve().parents[2]


def rate(run: Callable[[], None], steps: int, device: torch.device, seconds: float) -> float:
    """Steps a second of `run`, which makes `steps` of them, repeated for at least `seconds` after one warm-up."""

    def synchronise() -> None:
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    run()
    synchronise()
    started, count = time.perf_counter(), 0
    while True:
        run()
        synchronise()
        count += 1
        elapsed = time.perf_counter() - started
        if elapsed >= seconds:
            return steps * count / elapsed


def measure(config: Config, worlds: int, device: str, horizon: int, seconds: float) -> list[str]:
    """One row: control steps a second of all worlds together."""
    env: Any = make_env(config.env, config.physics, worlds, device, 0)
    generator = torch.Generator(device=env.device).manual_seed(0)
    shape = (horizon, worlds, env.action_size)
    actions = 0.3 * torch.randn(shape, generator=generator, device=env.device).clamp(-3, 3)

    def restart() -> None:
        env.state = env.reset_state()
        env.starts.stock(env.starts.draw_steps(horizon, env.group))

    def simulate() -> None:
        state = env.reset_state().physics
        with torch.no_grad():
            for action in actions:
                state = env.sim.step(env.control(action), *state)

    def forward() -> None:
        restart()
        with torch.no_grad():
            for action in actions:
                env.step(action)

    def both() -> None:
        restart()
        inputs = actions.clone().requires_grad_()
        total = torch.zeros((), device=env.device)
        for action in inputs:
            total = total + env.step(action).reward.mean()
        total.backward()

    rates = [rate(run, horizon * worlds, env.device, seconds) for run in (simulate, forward, both)]
    figures = [*(f"{value:,.0f}" for value in rates), f"{rates[1] / rates[2]:.2f}"]
    if env.device.type == "cuda" and env.sim.batch.kernels.fused_solver:
        replay = recorded(env, actions).replay
        figures.append(f"{rate(lambda: [replay() for _ in range(4)], 4 * horizon * worlds, env.device, seconds):,.0f}")
    else:
        figures.append("-")
    env.sim.diagnostics()  # raises if contacts were lost
    return [str(worlds), *figures]


def recorded(env: Any, actions: torch.Tensor) -> Recording[Any]:
    """Control steps under actions (H, W, A) from one state, and the gradient of their reward, as one CUDA graph."""
    start, resets = env.reset_state(), env.starts.draw_steps(len(actions), env.group)

    def work() -> Any:
        # Made here, because autograd would go on using the stream on which it first saw them.
        inputs = actions.clone().requires_grad_()
        env.state = start
        env.starts.stock(resets)
        total = torch.zeros((), device=env.device)
        for action in inputs:
            total = total + env.step(action).reward.mean()
        return torch.autograd.grad(total, inputs)

    work()
    recording = Recording(work, torch.cuda.Stream(env.device))
    env.state = start
    env.starts.stock(None)
    return recording


def c_mujoco(model: mujoco.MjModel, substeps: int, seconds: float) -> float:
    """Control steps a second of C MuJoCo on one thread: physics alone, from the standing pose."""
    data = mujoco.MjData(model)

    def run() -> None:
        mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
        for _ in range(32):
            mujoco.mj_step(model, data, nstep=substeps)

    return rate(run, 32, torch.device("cpu"), seconds)


def myosuite(name: str, seconds: float) -> tuple[float, float]:
    """Control steps a second of one of myosuite's environments, one thread, random actions, and how long one is [s]."""
    from myosuite.utils import gym

    env = gym.make(name)
    env.reset()
    env.action_space.seed(0)

    def run() -> None:
        for _ in range(50):
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()

    return rate(run, 50, torch.device("cpu"), seconds), float(env.unwrapped.dt)


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--models", nargs="+", choices=sorted(MODELS), default=sorted(MODELS))
    p.add_argument("--worlds", type=int, nargs="+", default=[64])
    p.add_argument("--horizon", type=int, default=16, help="control steps the gradient goes through")
    p.add_argument("--seconds", type=float, default=1.5, help="each figure is measured for at least this long")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument("--myosuite", metavar="ENV", default="myoLegWalk-v0", help="of myosuite, if that is installed")
    p.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    header = ["worlds", "physics", "forward", "forward + backward", "forward / both", "recorded"]
    for name in args.models:
        path, *overrides = MODELS[name]
        config = load_config(ROOT / path, [*overrides, *args.set])
        try:
            rows = []
            for worlds in args.worlds:
                rows.append(measure(config, worlds, args.device, args.horizon, args.seconds))
                print(name, rows[-1], flush=True)
        except ConfigError as error:
            print(f"{name}: {error}")
            continue
        one = make_env(config.env, config.physics, 1, "cpu", 0, differentiable=False)
        own = c_mujoco(one.model, one.sim.substeps, args.seconds)
        notes = [f"C MuJoCo, one CPU thread, physics alone: {own:,.0f} control steps/s."]
        if name == "myolegs":
            notes.append(find_model(None).describe() + ".")
            if importlib.util.find_spec("myosuite") is None:
                notes.append("myosuite is not installed: its own rate was not measured.")
            else:
                there, lasting = myosuite(args.myosuite, args.seconds)
                what = f"control steps/s of {1e3 * lasting:.0f} ms"
                notes.append(f"myosuite's {args.myosuite}, one CPU thread: {there:,.0f} {what}.")
        title = (
            f"Control steps a second of {name} (nv {one.model.nv}, muscles {one.action_size}), horizon {args.horizon}"
        )
        publish("legs", title, args.device, markdown_table(header, rows) + "\n\n" + " ".join(notes), args.results)


if __name__ == "__main__":
    main()
