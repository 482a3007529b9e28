"""Runs episodes of an unmodified task of mjlab for `scoring`, in a Python that has mjlab.

That Python has another version of MuJoCo and lacks this package, so this file imports nothing from it. It is started
with one JSON argument {task, seed, worlds, steps, pushed, motion, sampling, future}. On standard output it writes a
line of JSON that says what it runs, then the first observations of all worlds, and after each step a `record` of each
world. On standard input it reads the actions of all worlds before each step. mjlab's own messages go to standard error.
"""

import importlib.metadata
import json
import os
import sys

import numpy as np

PACKAGES = ("mjlab", "mujoco", "mujoco-warp", "torch")
ERRORS = {"twist": ("linear_error", "yaw_error"), "motion": ("mpkpe", "r_mpkpe")}
"""Errors that are measured besides the reward, for each command of mjlab."""


def record(observations: int, terms: int, command: str) -> np.dtype:
    """The type of what is written after a step for each world."""
    return np.dtype(
        [
            ("reward", "<f4"),
            ("terms", "<f4", (terms,)),
            *((name, "<f4") for name in ERRORS[command]),
            ("terminated", "?"),
            ("obs", "<f4", (observations,)),
        ]
    )


def velocity_errors(env, command):  # type: ignore[no-untyped-def]
    """Differences between the base's velocity and the command, each (W,)."""
    import torch

    robot = env.scene["robot"].data
    linear, angular = robot.root_link_lin_vel_b, robot.root_link_ang_vel_b
    return {
        "linear_error": torch.linalg.vector_norm(command.command[:, :2] - linear[:, :2], dim=-1),
        "yaw_error": (command.command[:, 2] - angular[:, 2]).abs(),
    }


def motion_errors(env, command):  # type: ignore[no-untyped-def]
    """mjlab's mean distances of the bodies from those of the motion [m], each (W,)."""
    from mjlab.tasks.tracking.mdp.metrics import compute_mpkpe, compute_root_relative_mpkpe

    return {"mpkpe": compute_mpkpe(command), "r_mpkpe": compute_root_relative_mpkpe(command)}


def task_for_scoring(  # type: ignore[no-untyped-def]
    task: str, pushed: bool, worlds: int, seed: int, device: str, motion: str | None = None, sampling: str = "start"
):
    """The environment of a mjlab task, and a dictionary into which each step writes the errors (W,) by name.

    Args:
        task: name of the task.
        pushed: whether to add the pushes and noise of training to mjlab's settings for playing.
        worlds: number of worlds W.
        seed: seed of the environment.
        device: "cpu" or "cuda:N".
        motion: path of the clip, for a task that follows one.
        sampling: where its episodes begin, "start" (mjlab's setting for playing) or "uniform".
    """
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.tasks.registry import load_env_cfg

    cfg = load_env_cfg(task, play=True)
    if pushed:
        cfg.events["push_robot"] = load_env_cfg(task).events["push_robot"]
        cfg.observations["actor"].enable_corruption = True
    if motion is not None:
        cfg.commands["motion"].motion_file, cfg.commands["motion"].sampling_mode = motion, sampling
    cfg.scene.num_envs, cfg.seed = worlds, seed
    env = ManagerBasedRlEnv(cfg, device)
    command = env.command_manager.get_term(command_name(motion))
    measure = velocity_errors if motion is None else motion_errors
    errors: dict = {}
    update = command.compute

    def measure_and_update(*args, **kwargs) -> None:  # type: ignore[no-untyped-def]
        # At this moment bodies are at the end of the step, and the command is still the one of its start.
        errors.update(measure(env, command))
        update(*args, **kwargs)

    command.compute = measure_and_update
    return env, errors


def with_future(command, shown, obs, future, last):  # type: ignore[no-untyped-def]
    """What a policy with `env.future_frames` sees: mjlab's observations, then their first entries for later frames.

    Args:
        command: mjlab's command, whose `time_steps` (W,) say which frame each world is in.
        shown: function that gives the entries (W, E) for the frames in `time_steps`, without noise.
        obs: observations (W, O), whose first E entries are `shown`, perhaps with noise; later frames get the same
            noise, because it is an error of where the robot believes to be.
        future: how many env steps ahead.
        last: the last frame.

    Returns:
        (W, O + E × number of later frames).
    """
    import torch

    now = command.time_steps
    present = shown()
    error, parts = obs[:, : present.shape[1]] - present, [obs]
    for ahead in future:
        command.time_steps = (now + ahead).clamp_max(last)
        parts.append(shown() + error)
    command.time_steps = now
    return torch.cat(parts, dim=-1)


def policy_view(env, future):  # type: ignore[no-untyped-def]
    """A function from the observations that mjlab gives to those that the policy sees, as `with_future`."""
    if not future:
        return lambda obs: obs["actor"]
    import torch
    from mjlab.tasks.tracking.mdp import motion_anchor_ori_b, motion_anchor_pos_b

    command = env.command_manager.get_term("motion")
    placed = "motion_anchor_pos_b" in env.observation_manager.active_terms["actor"]
    terms = [motion_anchor_pos_b, motion_anchor_ori_b] if placed else [motion_anchor_ori_b]

    def shown():  # type: ignore[no-untyped-def]
        return torch.cat([command.command, *(term(env, "motion") for term in terms)], dim=-1)

    return lambda obs: with_future(command, shown, obs["actor"], future, command.motion.time_step_total - 1)


def command_name(motion: str | None) -> str:
    """mjlab's name for the command of a task with or without a motion."""
    return "twist" if motion is None else "motion"


def main() -> None:
    """Run the steps that the argument orders; worlds that fall begin another episode."""
    order = json.loads(sys.argv[1])
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # mjlab prints to standard output, which is for answers alone
    os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is drawn

    import torch

    worlds = order["worlds"]
    device = "cuda:0" if torch.cuda.is_available() else "cpu"
    motion = order["motion"]
    env, errors = task_for_scoring(
        order["task"], order["pushed"], worlds, order["seed"], device, motion, order["sampling"]
    )
    view = policy_view(env, order["future"])
    obs = view(env.reset()[0])
    terms = env.reward_manager.active_terms
    observations, actions = obs.shape[1], env.action_manager.total_action_dim
    hello = {
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        "device": torch.cuda.get_device_name(0) if device != "cpu" else "cpu",
        "observations": observations,
        "actions": actions,
        "terms": terms,
    }
    answers.write(json.dumps(hello).encode() + b"\n")
    answers.write(obs.cpu().numpy().astype("<f4").tobytes())
    answers.flush()
    answer = np.zeros(worlds, record(observations, len(terms), command_name(motion)))
    for _ in range(order["steps"]):
        action = np.frombuffer(sys.stdin.buffer.read(4 * worlds * actions), "<f4").reshape(worlds, actions)
        obs, reward, terminated, _, _ = env.step(torch.from_numpy(action.copy()).to(device))
        weighted = env.reward_manager._step_reward * env.step_dt
        results = {"reward": reward, "terms": weighted, "terminated": terminated, "obs": view(obs), **errors}
        for name, value in results.items():
            answer[name] = value.cpu().numpy()
        answers.write(answer.tobytes())
        answers.flush()


if __name__ == "__main__":
    main()
