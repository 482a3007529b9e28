"""PPO (rsl-rl-lib) on an environment of msk_ray: the baseline beside SHAC.

Same worlds, physics, rewards and resets as the trial whose config is named, and the same evaluation; only the
algorithm differs. Writes metrics.jsonl with the columns that `python -m msk_ray.train` writes. Needs the extra `ppo`:
pip install -e '.[ppo]'.
"""

import argparse
import contextlib
import io
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from msk_ray.config import Config, load_config
from msk_ray.envs import Env, make_env
from msk_ray.training.evaluation import Evaluator

try:
    from rsl_rl.env import VecEnv
    from rsl_rl.runners import OnPolicyRunner
    from tensordict import TensorDict
except ImportError as error:
    sys.exit(f"{error}: PPO needs the extra, pip install -e '.[ppo]'")


class Worlds(VecEnv):
    """An msk_ray environment as rsl_rl sees it: actions are clamped to [-1, 1], nothing is differentiated."""

    def __init__(self, env: Env[Any]) -> None:
        self.env = env
        self.num_envs = env.nworld
        self.num_actions = env.action_size
        self.max_episode_length = env.config.episode_length
        self.episode_length_buf = env.state.age
        self.device = env.device
        self.cfg: dict[str, Any] = {}

    def get_observations(self) -> TensorDict:
        """Observations (W, O) of where the worlds are, under the one group both networks read."""
        return TensorDict({"policy": self.env.observation()}, batch_size=[self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One env step; a truncated episode is a time-out, whose value PPO bootstraps."""
        transition = self.env.step(actions.clamp(-1.0, 1.0))
        self.episode_length_buf = self.env.state.age
        done = (transition.terminated | transition.truncated).long()
        return self.get_observations(), transition.reward, done, {"time_outs": transition.truncated}


def settings(config: Config, steps: int) -> dict[str, Any]:
    """rsl_rl's settings: its defaults for locomotion, with the trial's network sizes, discount and λ."""
    network = {"class_name": "MLPModel", "activation": config.actor.activation, "obs_normalization": True}
    return {
        "num_steps_per_env": steps,
        "save_interval": 10**9,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": {
            **network,
            "hidden_dims": list(config.actor.hidden),
            "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "log"},
        },
        "critic": {**network, "hidden_dims": list(config.critic.hidden)},
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": 5,
            "num_mini_batches": 4,
            "clip_param": 0.2,
            "gamma": config.shac.gamma,
            "lam": config.shac.lam,
            "value_loss_coef": 1.0,
            "use_clipped_value_loss": True,
            "entropy_coef": 0.0,
            "learning_rate": 1e-3,
            "schedule": "adaptive",
            "desired_kl": 0.01,
            "max_grad_norm": 1.0,
        },
        "multi_gpu": None,
    }


def main() -> None:
    """Train by PPO until the wall-clock limit or the last iteration."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--config", type=Path, required=True, help="trial whose env, physics and networks are taken")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--nworld", type=int, default=4096)
    p.add_argument("--steps", type=int, default=24, help="env steps a world and iteration")
    p.add_argument("--iterations", type=int, default=2000)
    p.add_argument("--evaluate-every", type=int, default=25, metavar="N", help="iterations between evaluations")
    p.add_argument("--seconds", type=float, default=float("inf"), help="stop after this much training time")
    p.add_argument("--device", default="cuda:0")
    p.add_argument("--logdir", type=Path, required=True)
    args = p.parse_args()
    torch.manual_seed(args.seed)
    config = load_config(args.config, [f"trial.seed={args.seed}", f"env.nworld={args.nworld}"])
    env = make_env(config.env, config.physics, args.nworld, args.device, args.seed, differentiable=False)
    evaluator = Evaluator(config, args.device)
    args.logdir.mkdir(parents=True, exist_ok=True)
    log = (args.logdir / "metrics.jsonl").open("w", encoding="utf-8")
    with contextlib.redirect_stdout(io.StringIO()):
        runner = OnPolicyRunner(Worlds(env), settings(config, args.steps), None, args.device)
    best, seconds, done = float("-inf"), 0.0, 0

    @torch.no_grad()
    def policy(obs: Tensor) -> Tensor:
        action: Tensor = runner.alg.get_policy()(TensorDict({"policy": obs}, batch_size=[len(obs)]))
        return action.clamp(-1.0, 1.0)

    while True:
        started = time.perf_counter()
        runner.alg.eval_mode()
        figures = evaluator.run(policy)
        best = max(best, figures["score"])
        seconds += time.perf_counter() - started
        row = {
            "epoch": done,
            "env_steps": done * args.steps * args.nworld,
            "seconds": seconds,
            **{f"eval/{name}": value for name, value in figures.items()},
            "eval/best_score": best,
        }
        log.write(json.dumps(row) + "\n")
        log.flush()
        print(
            f"iteration {done}: score {figures['score']:.0f}, vx {figures.get('vx', 0.0):.2f}, {seconds:.0f} s",
            flush=True,
        )
        if done >= args.iterations or seconds >= args.seconds:
            break
        started = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints a page an iteration
            runner.learn(args.evaluate_every)
            runner.current_learning_iteration += 1
        done += args.evaluate_every
        if env.device.type == "cuda":
            torch.cuda.synchronize(env.device)
        seconds += time.perf_counter() - started
    env.sim.diagnostics()  # raises if contacts were lost
    print(f"best score {best:.0f}: {args.logdir / 'metrics.jsonl'}")


if __name__ == "__main__":
    main()
