"""mjlab's own training of a task with its own settings, scored in the same task after given times of wall-clock.

    PYTHON_OF_MJLAB benchmarks/mjlab_ppo.py Mjlab-Velocity-Flat-Unitree-Go1 --minutes 1 2 3 5 --to ppo.json

It runs in a Python that has mjlab, which needs another MuJoCo than this package, and imports none of the package but
one file. Time counts from the start of this process to the end of the iteration in which it is up; scoring comes after
training and is not counted. Policies are scored as `msk-ray evaluate --in mjlab` does: deterministic, the first episode
of each world, with mjlab's settings for playing and then with training's pushes and noise. A line is printed for each
score and the file has all of them.
"""

import time

BEGIN = time.monotonic()

import argparse  # noqa: E402
import contextlib  # noqa: E402
import importlib.metadata  # noqa: E402
import json  # noqa: E402
import os  # noqa: E402
import sys  # noqa: E402
from dataclasses import asdict  # noqa: E402
from pathlib import Path  # noqa: E402

os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is drawn

import torch  # noqa: E402
from mjlab.envs import ManagerBasedRlEnv  # noqa: E402
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper  # noqa: E402
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "msk_ray/robots/mjlab"))
import worker  # type: ignore[import-not-found]  # noqa: E402

STEPS = 1000
"""Of an episode, 20 s."""


class TimeIsUp(Exception):
    """The last of the times has come."""


def main() -> None:
    """Train, score and write what the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("task", help="name of a velocity task of mjlab")
    p.add_argument("--minutes", type=float, nargs="+", default=[1.0, 2.0, 3.0, 5.0], help="when policies are kept")
    p.add_argument("--worlds", type=int, default=4096, help="mjlab's examples train with 4096")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--episodes", type=int, default=256, help="of 1000 steps")
    p.add_argument("--device", default="cuda:0")
    p.add_argument("--to", type=Path, required=True, help="JSON file that is written")
    args = p.parse_args()
    policy, kept = train(args)
    result = {
        "task": args.task,
        "seed": args.seed,
        "worlds": args.worlds,
        "versions": {name: importlib.metadata.version(name) for name in (*worker.PACKAGES, "rsl-rl-lib")},
        "device": torch.cuda.get_device_name(args.device) if args.device != "cpu" else "cpu",
        "scores": [],
    }
    for pushed in (False, True):
        env, errors = worker.task_for_scoring(args.task, pushed, args.episodes, 0, args.device)
        for state, facts in kept:
            with torch.inference_mode():  # as in training, or its statistics of observations are refused
                policy.load_state_dict(state)
            row = {**facts, "pushed": pushed, **score(env, errors, policy)}
            result["scores"].append(row)
            print(json.dumps(row), flush=True)
            args.to.write_text(json.dumps(result, indent=1))
        env.close()
    print(f"Wrote {args.to}")


def train(args: argparse.Namespace) -> tuple[torch.nn.Module, list[tuple[dict[str, torch.Tensor], dict[str, float]]]]:
    """The policy, its states at the times asked for, and when each was."""
    cfg, agent = load_env_cfg(args.task), load_rl_cfg(args.task)
    cfg.scene.num_envs, cfg.seed, agent.seed = args.worlds, args.seed, args.seed
    torch.manual_seed(args.seed)
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, args.device), clip_actions=agent.clip_actions)
    runner = MjlabOnPolicyRunner(env, asdict(agent), None, args.device)  # no folder: nothing is logged or saved
    policy = runner.alg.get_policy()
    waiting, kept = sorted(60.0 * minutes for minutes in args.minutes), []
    print(f"{time.monotonic() - BEGIN:.1f} s: training begins", flush=True)

    def keep(it: int, **others: object) -> None:
        seconds = time.monotonic() - BEGIN
        if seconds < waiting[0]:
            return
        waiting.pop(0)
        steps = (it + 1) * agent.num_steps_per_env * args.worlds
        facts = {"seconds": round(seconds, 1), "iterations": it + 1, "env_steps": steps}
        kept.append(({name: value.clone() for name, value in policy.state_dict().items()}, facts))
        print(json.dumps(facts), flush=True)
        if not waiting:
            raise TimeIsUp

    runner.logger.log = keep
    with contextlib.suppress(TimeIsUp):
        runner.learn(sys.maxsize, init_at_random_ep_len=True)
    env.close()
    return policy.eval(), kept


@torch.inference_mode()
def score(env, errors, policy) -> dict[str, float]:  # type: ignore[no-untyped-def]
    """Means over the first episodes of all worlds."""
    obs, _ = env.reset(seed=0)
    worlds = env.num_envs
    running = torch.ones(worlds, dtype=torch.bool, device=env.device)
    an_episode = dict.fromkeys(("return", "fell"), 0.0)
    a_step: dict[str, float] = {}
    steps = 0.0
    for _ in range(STEPS):
        obs, reward, terminated, _, _ = env.step(policy(obs))
        ended = running & terminated
        an_episode["return"] += (reward * running).sum()
        an_episode["fell"] += ended.sum()
        for name, error in errors.items():
            # A world that fell is elsewhere already when errors are measured.
            a_step[name] = a_step.get(name, 0.0) + (error * (running & ~ended)).sum()
        steps += running.sum()
        running &= ~ended
    means = {name: value / worlds for name, value in an_episode.items()}
    means |= {name: value / steps for name, value in a_step.items()}
    return {name: round(float(mean), 4) for name, mean in means.items()}


if __name__ == "__main__":
    main()
