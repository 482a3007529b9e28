"""Who acts in the episodes of a viewer.

Axes: W worlds, O observation, A action.
"""

from typing import Any

import torch
from torch import Tensor

from msk_ray.envs import Env
from msk_ray.training.policy_group import Policy


def zero_policy(env: Env[Any]) -> Policy:
    """The action 0, which controls of an environment may turn into more: servos hold their default pose."""
    action = torch.zeros((env.nworld, env.action_size), device=env.device)
    return lambda obs: action


def random_policy(env: Env[Any], seed: int) -> Policy:
    """Actions uniform in [-1, 1], new in every step, from a generator of their own: starts do not depend on them."""
    generator = torch.Generator().manual_seed(seed)

    def policy(obs: Tensor) -> Tensor:
        return (2.0 * torch.rand((env.nworld, env.action_size), generator=generator) - 1.0).to(env.device)

    return policy
