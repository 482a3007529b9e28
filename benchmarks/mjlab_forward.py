"""Time of mjlab's own forward env step of the robots, to compare with benchmarks/robots.py on the same machine.

    PYTHON_OF_MJLAB benchmarks/mjlab_forward.py                                    # Go1 with 8192 worlds, G1 with 4096
    PYTHON_OF_MJLAB benchmarks/mjlab_forward.py --worlds 4 --device cpu --steps 1  # a try

It runs in a Python that has mjlab, and imports nothing of the package. The worlds begin after 15 env steps under random
actions of deviation 0.3 about the default pose. `physics` is four steps of mjlab's simulation, recorded as a graph, and
nothing else; `environment` is its env step with actuators, rewards, observations and resets. Medians of three rounds.
"""

import argparse
import os

os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is drawn

import torch
from clock import milliseconds
from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_env_cfg

TASKS = {"Mjlab-Velocity-Flat-Unitree-Go1": 8192, "Mjlab-Velocity-Flat-Unitree-G1": 4096}


@torch.inference_mode()
def measure(task: str, args: argparse.Namespace) -> None:
    """Print the times of a task's step."""
    cfg = load_env_cfg(task)
    cfg.scene.num_envs, cfg.seed = args.worlds or TASKS[task], 0
    env = ManagerBasedRlEnv(cfg, args.device)
    env.reset()
    worlds, actions = env.num_envs, env.action_manager.total_action_dim
    for _ in range(15):
        env.step(0.3 * torch.randn(worlds, actions, device=args.device))

    def physics() -> None:
        for _ in range(cfg.decimation):
            env.sim.step()

    last = 0.3 * torch.randn(worlds, actions, device=args.device)
    for name, step in (("environment", lambda: env.step(last)), ("physics", physics)):
        taken = milliseconds(step, torch.device(args.device), args.steps)
        print(f"{task} {worlds} worlds, {name}: {taken:.2f} ms, {1e3 * worlds / taken:,.0f} env steps/s", flush=True)
    env.close()


def main() -> None:
    """Measure what the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--worlds", type=int, help="default: 8192 for Go1, 4096 for G1")
    p.add_argument("--device", default="cuda:0")
    p.add_argument("--steps", type=int, default=20, help="env steps of a round")
    args = p.parse_args()
    for task in TASKS:
        measure(task, args)


if __name__ == "__main__":
    main()
