"""Runs episodes of an unmodified velocity task of mjlab for `scoring`, in a Python that has mjlab.

That Python has other versions of MuJoCo and lacks this package, so this file imports nothing of it. It is started with
one JSON argument {task, seed, worlds, steps, pushed}. On standard output it writes a line of JSON, which says what it
runs, then the first observations, and a `record` after each step, of all worlds; on standard input it reads their
actions before each step. mjlab's own messages go to standard error.
"""

import importlib.metadata
import json
import os
import sys

import numpy as np

PACKAGES = ("mjlab", "mujoco", "mujoco-warp", "torch")
ERRORS = ("linear_error", "yaw_error")


def record(observations: int, terms: int) -> np.dtype:
    """What follows a step, for each world."""
    return np.dtype(
        [
            ("reward", "<f4"),
            ("terms", "<f4", (terms,)),
            ("linear_error", "<f4"),
            ("yaw_error", "<f4"),
            ("terminated", "?"),
            ("obs", "<f4", (observations,)),
        ]
    )


def task_for_scoring(task: str, pushed: bool, worlds: int, seed: int, device: str):  # type: ignore[no-untyped-def]
    """The environment of a task with mjlab's settings for playing, or with training's pushes and noise besides; and the
    distances from the command, which are filled in each step."""
    import torch
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.tasks.registry import load_env_cfg

    cfg = load_env_cfg(task, play=True)
    if pushed:
        cfg.events["push_robot"] = load_env_cfg(task).events["push_robot"]
        cfg.observations["actor"].enable_corruption = True
    cfg.scene.num_envs, cfg.seed = worlds, seed
    env = ManagerBasedRlEnv(cfg, device)
    robot, command = env.scene["robot"].data, env.command_manager.get_term("twist")
    errors: dict[str, torch.Tensor] = {}
    update = command.compute

    def compute(*given, **named) -> None:  # type: ignore[no-untyped-def]
        # mjlab calls it when bodies are those of the end of the step; the command is still that of its start.
        linear, angular = robot.root_link_lin_vel_b, robot.root_link_ang_vel_b
        errors["linear_error"] = torch.linalg.vector_norm(command.command[:, :2] - linear[:, :2], dim=-1)
        errors["yaw_error"] = (command.command[:, 2] - angular[:, 2]).abs()
        update(*given, **named)

    command.compute = compute
    return env, errors


def main() -> None:
    """Run the steps that the argument asks for; worlds that fall begin another episode."""
    asked = json.loads(sys.argv[1])
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # mjlab prints
    os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is drawn

    import torch

    worlds = asked["worlds"]
    device = "cuda:0" if torch.cuda.is_available() else "cpu"
    env, errors = task_for_scoring(asked["task"], asked["pushed"], worlds, asked["seed"], device)
    obs, _ = env.reset()
    terms = env.reward_manager.active_terms
    observations, actions = obs["actor"].shape[1], env.action_manager.total_action_dim
    hello = {
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        "device": torch.cuda.get_device_name(0) if device != "cpu" else "cpu",
        "observations": observations,
        "actions": actions,
        "terms": terms,
    }
    answers.write(json.dumps(hello).encode() + b"\n")
    answers.write(obs["actor"].cpu().numpy().astype("<f4").tobytes())
    answers.flush()
    answer = np.zeros(worlds, record(observations, len(terms)))
    for _ in range(asked["steps"]):
        given = np.frombuffer(sys.stdin.buffer.read(4 * worlds * actions), "<f4").reshape(worlds, actions)
        obs, reward, terminated, _, _ = env.step(torch.from_numpy(given.copy()).to(device))
        weighted = env.reward_manager._step_reward * env.step_dt
        found = {"reward": reward, "terms": weighted, "terminated": terminated, "obs": obs["actor"], **errors}
        for name, value in found.items():
            answer[name] = value.cpu().numpy()
        answers.write(answer.tobytes())
        answers.flush()


if __name__ == "__main__":
    main()
