"""mjlab's own training of a task with its own settings, scored in the same task after given times of wall-clock.

    PYTHON_OF_MJLAB benchmarks/mjlab_ppo.py train Mjlab-Velocity-Flat-Unitree-Go1 --minutes 1 2 3 5 --to ppo
    PYTHON_OF_MJLAB benchmarks/mjlab_ppo.py score ppo
    PYTHON_OF_MJLAB benchmarks/mjlab_ppo.py train Mjlab-Tracking-Flat-Unitree-G1 --motion dance.npz --to ppo_dance

It runs in a Python that has mjlab, which needs another MuJoCo than this package, and imports none of the package but
one file. `train` writes the policy to the folder at each of the times, which count from the start of this process to
the end of the iteration in which the time is up. `score`, on this or another machine, plays them as `msk-ray evaluate
--in mjlab` does: deterministic, the first episode of each world, with mjlab's settings for playing and then with
training's pushes and noise. It prints a line for each and writes all to scores.json in the folder. `msk-ray motions
CLIP.csv --npz FOLDER` writes the clips that tracking tasks follow.
"""

import time

BEGIN = time.monotonic()

import argparse  # noqa: E402
import contextlib  # noqa: E402
import importlib.metadata  # noqa: E402
import json  # noqa: E402
import os  # noqa: E402
import shutil  # noqa: E402
import sys  # noqa: E402
from dataclasses import asdict  # noqa: E402
from pathlib import Path  # noqa: E402

os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is drawn

import torch  # noqa: E402
from mjlab.envs import ManagerBasedRlEnv  # noqa: E402
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper  # noqa: E402
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "msk_ray/robots/mjlab"))
import mjlab_side  # type: ignore[import-not-found]  # noqa: E402

MOTION = "motion.npz"
"""Copy of the clip beside the policies of a tracking task."""


class TimeIsUp(Exception):
    """The last of the times has come."""


def main() -> None:
    """Do what the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--device", default="cuda:0")
    commands = p.add_subparsers(required=True)
    t = commands.add_parser("train", help="train, keeping policies")
    t.add_argument("task", help="name of a velocity or tracking task of mjlab")
    t.add_argument("--minutes", type=float, nargs="+", default=[1.0, 2.0, 3.0, 5.0], help="when policies are kept")
    t.add_argument("--worlds", type=int, default=4096, help="mjlab's examples train with 4096")
    t.add_argument("--seed", type=int, default=0)
    t.add_argument("--motion", type=Path, help="clip that a tracking task follows, .npz")
    t.add_argument("--to", type=Path, required=True, help="folder for the policies, not yet there")
    t.set_defaults(run=train)
    s = commands.add_parser("score", help="score the policies in a folder")
    s.add_argument("folder", type=Path)
    s.add_argument("--episodes", type=int, default=256, help="one in each world")
    s.add_argument(
        "--steps", type=int, default=1000, help="of an episode, 20 ms each; an episode ends earlier in a fall"
    )
    s.add_argument("--sampling", choices=("start", "uniform"), default="start", help="where in a clip episodes begin")
    s.set_defaults(run=score)
    args = p.parse_args()
    args.run(args)


def train(args: argparse.Namespace) -> None:
    """Train until the last of the times. A line is printed every 25 iterations and for each policy that is kept."""
    if args.to.exists():
        raise SystemExit(f"{args.to} exists: write another folder in --to")
    cfg = load_env_cfg(args.task)
    cfg.scene.num_envs, cfg.seed = args.worlds, args.seed
    if ("motion" in cfg.commands) != (args.motion is not None):
        raise SystemExit(f"--motion: {args.task} follows " + ("a clip: write one" if args.motion is None else "none"))
    if args.motion is not None and not args.motion.is_file():
        raise SystemExit(f"--motion: there is no {args.motion}; msk-ray motions CLIP.csv --npz FOLDER writes one")
    args.to.mkdir(parents=True)
    if args.motion is not None:
        cfg.commands["motion"].motion_file = shutil.copyfile(args.motion, str(args.to / MOTION))
    torch.manual_seed(args.seed)
    env, runner = runner_in(ManagerBasedRlEnv(cfg, args.device), args.task, args.seed, args.device)
    waiting = sorted(60.0 * minutes for minutes in args.minutes)
    trial = {"task": args.task, "seed": args.seed, "worlds": args.worlds, "trained_on": device_name(args.device)}
    print(f"{time.monotonic() - BEGIN:.1f} s: training begins", flush=True)

    def keep(it: int, **others: object) -> None:
        seconds = time.monotonic() - BEGIN
        steps = (it + 1) * runner.cfg["num_steps_per_env"] * args.worlds
        facts = {"seconds": round(seconds, 1), "iterations": it + 1, "env_steps": steps}
        returns = runner.logger.rewbuffer
        if it % 25 == 0 and returns:
            print(json.dumps(facts | {"return_in_training": round(sum(returns) / len(returns), 2)}), flush=True)
        if seconds < waiting[0]:
            return
        waiting.pop(0)
        file = args.to / f"{it + 1:06d}.pt"
        torch.save({"facts": trial | facts, "policy": runner.alg.get_policy().state_dict()}, file)
        print(f"Wrote {file} after {seconds:.0f} s", flush=True)
        if not waiting:
            raise TimeIsUp

    runner.logger.log = keep
    with contextlib.suppress(TimeIsUp):
        runner.learn(sys.maxsize, init_at_random_ep_len=True)
    env.close()


def runner_in(env, task: str, seed: int, device: str):  # type: ignore[no-untyped-def]
    """The environment as rsl_rl wants it, and mjlab's trainer in it, which writes no files."""
    agent = load_rl_cfg(task)
    agent.seed = seed
    wrapped = RslRlVecEnvWrapper(env, clip_actions=agent.clip_actions)
    return wrapped, MjlabOnPolicyRunner(wrapped, asdict(agent), None, device)


def score(args: argparse.Namespace) -> None:
    """Score all policies of the folder, under both settings."""
    files = sorted(args.folder.glob("*.pt"))
    if not files:
        raise SystemExit(f"{args.folder} holds no policies (*.pt); make some with: train TASK --to {args.folder}")
    kept = [torch.load(file, map_location=args.device, weights_only=True) for file in files]
    task, motion = kept[0]["facts"]["task"], args.folder / MOTION
    versions = {name: importlib.metadata.version(name) for name in (*mjlab_side.PACKAGES, "rsl-rl-lib")}
    how = {"episodes": args.episodes, "steps": args.steps, "sampling": args.sampling}
    result = {"versions": versions, "scored_on": device_name(args.device), **how, "scores": []}
    to = args.folder / "scores.json"
    for pushed in (False, True):
        unwrapped, errors = mjlab_side.task_for_scoring(
            task, pushed, args.episodes, 0, args.device, str(motion) if motion.exists() else None, args.sampling
        )
        env, runner = runner_in(unwrapped, task, 0, args.device)
        policy = runner.alg.get_policy().eval()
        for saved in kept:
            with torch.inference_mode():  # as in training, or its statistics of observations are refused
                policy.load_state_dict(saved["policy"])
            row = {**saved["facts"], "pushed": pushed, **means(unwrapped, errors, policy, args.steps)}
            result["scores"].append(row)
            print(json.dumps(row), flush=True)
            to.write_text(json.dumps(result, indent=1), encoding="utf-8")
        env.close()
    print(f"Wrote {to}")


def device_name(device: str) -> str:
    return torch.cuda.get_device_name(device) if device != "cpu" else "cpu"


@torch.inference_mode()
def means(env, errors, policy, steps_of_episode: int) -> dict[str, float]:  # type: ignore[no-untyped-def]
    """Means over the first episodes of all worlds."""
    obs, _ = env.reset(seed=0)
    worlds = env.num_envs
    running = torch.ones(worlds, dtype=torch.bool, device=env.device)
    an_episode = dict.fromkeys(("return", "fell"), 0.0)
    a_step: dict[str, float] = {}
    steps = 0.0
    for _ in range(steps_of_episode):
        obs, reward, terminated, _, _ = env.step(policy(obs))
        ended = running & terminated
        an_episode["return"] += (reward * running).sum()
        an_episode["fell"] += ended.sum()
        for name, error in errors.items():
            # A world that fell is elsewhere already when errors are measured.
            a_step[name] = a_step.get(name, 0.0) + (error * (running & ~ended)).sum()
        steps += running.sum()
        running &= ~ended
        if not running.any():
            break
    found = {name: value / worlds for name, value in an_episode.items()}
    found["length"] = steps / worlds
    found |= {name: value / steps for name, value in a_step.items()}
    return {name: round(float(mean), 4) for name, mean in found.items()}


if __name__ == "__main__":
    main()
