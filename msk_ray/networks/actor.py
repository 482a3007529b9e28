"""The policy."""

import torch
from torch import Tensor, nn

from msk_ray.config.schema import ActorConfig
from msk_ray.networks.mlp import make_mlp


class Actor(nn.Module):
    """Action tanh(μ(obs) + σ·noise) with a state-independent σ, or tanh(μ(obs)) if deterministic."""

    def __init__(self, config: ActorConfig, obs_size: int, action_size: int, generator: torch.Generator) -> None:
        super().__init__()
        self.mean = make_mlp(config, obs_size, action_size, generator)
        self.log_std = nn.Parameter(torch.full((action_size,), config.log_std)) if config.stochastic else None

    def forward(self, obs: Tensor, noise: Tensor | None = None) -> Tensor:
        """Actions (..., A) in (-1, 1) for normalised observations (..., O).

        Args:
            noise: standard normal numbers (..., A), through which the sample is differentiable; None for the
                deterministic action.
        """
        action = self.mean(obs)
        if noise is not None and self.log_std is not None:
            action = action + self.log_std.exp() * noise
        return torch.tanh(action)
