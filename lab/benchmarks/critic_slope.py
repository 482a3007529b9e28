"""How good is the slope of a trial's critic, and the policy gradient of rollouts that end in it?

    python lab/benchmarks/critic_slope.py runs/train/g1_velocity_seed0/checkpoints/epoch_001500.pt

From states of a deterministic policy in mid-motion, the discounted return of H env steps plus the critic's value of the
last state is differentiated with respect to the first state, to the first four actions, and to the policy's weights
through these four. Printed is the cosine with the same of 64 env steps: median and lower quartile over worlds, and one
of the whole batch for the weights. Needs a checkpoint that training can continue from, of a robot with a free joint.
"""

import argparse
import copy
import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "docs/examples"))
from world_model_audit import displaced

from msk_ray.algorithms.shac.algorithm import Shac
from msk_ray.envs import make_env
from msk_ray.training import load_policy
from msk_ray.training.checkpoint import read_checkpoint

HORIZONS = (0, 1, 2, 4, 8, 16, 32, 64)
FIRST = 4
"""Actions at the start whose gradients are compared: those of a rollout with horizon 4."""
SETTLE = 60
"""Env steps before the states."""

p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
p.add_argument("checkpoint", type=Path)
p.add_argument("--worlds", type=int, default=64)
p.add_argument("--seed", type=int, default=1)
args = p.parse_args()

config = load_policy(args.checkpoint).config
settings = {"command_schedule": None, "spread_resets": False, "episode_length": 1000, "nworld": args.worlds}
config = config.model_copy(
    update={
        "env": config.env.model_copy(update=settings),
        "physics": config.physics.model_copy(update={"randomize": None}),
    }
)
env = make_env(config.env, config.physics, args.worlds, "cpu", args.seed)
shac = Shac(config, env)
modules = read_checkpoint(args.checkpoint)["algorithm"]["modules"]
for name, module in shac.modules().items():
    module.load_state_dict(modules[name])
normalize, gamma = shac.normalizer.fixed(), shac.settings.gamma
trained, frozen = shac.actor, copy.deepcopy(shac.actor).requires_grad_(False)
quiet = torch.zeros(args.worlds, env.action_size)


def value(obs: torch.Tensor) -> torch.Tensor:
    """The critic's value (W,) of observations (W, O)."""
    return shac.critic(normalize(obs)[None])[:, 0].amin(0)


env.state = env.reset_state()
with torch.no_grad():
    for _ in range(SETTLE):
        env.step(frozen(normalize(env.observation()), quiet))
        env.state = env.state.detach()
by = torch.zeros(args.worlds, 2 * env.model.nv, requires_grad=True)
added = torch.zeros(FIRST, args.worlds, env.action_size, requires_grad=True)
weights = [weight for name, weight in trained.named_parameters() if "log_std" not in name]
env.state = env.state._replace(physics=displaced(env.state.physics, by, linear=True))
slopes = {0: torch.autograd.grad(value(env.observation()).sum(), by, retain_graph=True)[0]}
actions, policies = {}, {}
total, stands = torch.zeros(args.worlds), torch.ones(args.worlds, dtype=torch.bool)
for t in range(HORIZONS[-1]):
    obs = normalize(env.observation())
    action = trained(obs, quiet) + added[t] if t < FIRST else frozen(obs, quiet)
    transition = env.step(action, auto_reset=False)
    stands &= ~transition.terminated
    total = total + gamma**t * transition.reward
    if (horizon := t + 1) in HORIZONS:
        objective = (total + gamma**horizon * value(transition.obs)).sum()
        slopes[horizon] = torch.autograd.grad(objective, by, retain_graph=True)[0]
        if horizon >= FIRST:
            actions[horizon] = torch.autograd.grad(objective, added, retain_graph=True)[0].transpose(0, 1).flatten(1)
            parts = torch.autograd.grad(objective, weights, retain_graph=True)
            policies[horizon] = torch.cat([part.flatten() for part in parts])[None]

print(f"discount {gamma}, {int(stands.sum())} of {args.worlds} worlds did not fall")
last = HORIZONS[-1]
for title, found, rows in (
    ("first state", slopes, stands),
    ("first actions", actions, stands),
    ("weights", policies, slice(None)),
):
    print(title)
    for horizon, gradient in found.items():
        mine, true = gradient[rows].double(), found[last][rows].double()
        cosine = torch.nn.functional.cosine_similarity(mine, true, dim=-1)
        size = (mine.norm(dim=-1) / true.norm(dim=-1)).median()
        print(f"  {horizon:3d}  cosine {cosine.median():.2f}, quartile {cosine.quantile(0.25):.2f}, size {size:.2f}")
