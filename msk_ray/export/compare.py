"""Compare an exported policy with the checkpoint's: on observations, and over steps of its environment.

Axes: N observations, O observation.
"""

from typing import Any

import torch
from torch import Tensor

from msk_ray.envs import Env
from msk_ray.errors import ExportError
from msk_ray.export.find_memory import NOISE
from msk_ray.export.network import PolicyToControl, Runner

TOLERANCE = 1e-5
"""Largest accepted difference from the checkpoint's policy, in actions and in controls; controls are divided by their
largest magnitude if that is above 1."""
CHECKED = 1000
"""Observations on which an exported policy is compared with the checkpoint's."""
STEPS = 50
"""Env steps over which one that remembers is compared."""
WORLDS = 8
"""Worlds whose initial states give the observations."""


@torch.no_grad()
def observations(env: Env[Any], seed: int) -> Tensor:
    """`CHECKED` observations (N, O) of initial states, with noise so that no two are equal."""
    generator = torch.Generator().manual_seed(seed)
    rounds = -(-CHECKED // env.nworld)
    drawn = []
    for _ in range(rounds):
        env.state = env.reset_state()
        drawn.append(env.observation().cpu())
    obs = torch.cat(drawn)[:CHECKED]
    return obs + NOISE * torch.randn(obs.shape, generator=generator)


def compare_with_checkpoint(policy: PolicyToControl, run: Runner, env: Env[Any], *inputs: Tensor) -> float:
    """Largest difference between an exported policy and the checkpoint's, on these inputs and, if it carries memories,
    over steps of its environment.

    Raises:
        ExportError: it is above `TOLERANCE`, or not a number.
    """
    difference = largest_difference(policy, run, *inputs)
    return max(difference, difference_over_steps(policy, run, env)) if policy.memory.start else difference


@torch.no_grad()
def largest_difference(policy: PolicyToControl, run: Runner, *inputs: Tensor) -> float:
    """Largest difference between the outputs of an exported policy and the checkpoint's, one by one and in a batch.

    Raises:
        ExportError: it is above `TOLERANCE`, or not a number.
    """
    wanted = policy(*inputs)
    rows = zip(*(part[:WORLDS].split(1) for part in inputs), strict=True)
    single = [torch.cat(parts) for parts in zip(*(run(*row) for row in rows), strict=True)]
    outputs = [(name, ours, theirs) for name, ours, theirs in zip(policy.outputs, wanted, run(*inputs), strict=True)]
    outputs += [
        (name, ours[:WORLDS], theirs) for name, ours, theirs in zip(policy.outputs, wanted, single, strict=True)
    ]
    return max(_difference(*output, f"on one of {len(inputs[0])} observations") for output in outputs)


@torch.no_grad()
def difference_over_steps(policy: PolicyToControl, run: Runner, env: Env[Any]) -> float:
    """Largest difference in `STEPS` steps of the environment, from one call to the next, of an exported policy's
    actions and controls from the checkpoint's.

    Raises:
        ExportError: as for `largest_difference`.
    """
    env.state = env.reset_state()
    carried = [each.start.expand(env.nworld, -1) for each in policy.carried]
    worst = 0.0
    for step in range(STEPS):
        obs = env.observation()
        action = policy.network(obs)
        outputs = dict(zip(policy.outputs, run(policy.given(obs), *carried), strict=True))
        wanted = {"action": action, **({"ctrl": env.control(action)} if policy.gives_control else {})}
        for name, ours in wanted.items():
            worst = max(worst, _difference(name, ours, outputs[name], f"in step {step + 1} of an episode"))
        carried = [outputs[each.output] for each in policy.carried]
        env.step(action, auto_reset=False)
    return worst


def _difference(name: str, ours: Tensor, theirs: Tensor, where: str) -> float:
    difference = float((ours - theirs).abs().max() / ours.abs().max().clamp_min(1.0))
    if not difference <= TOLERANCE:
        raise ExportError(
            f"not written: its {name} differs from the checkpoint's by {difference:.1e} {where}, more than "
            f"{TOLERANCE:.0e}"
        )
    return difference
