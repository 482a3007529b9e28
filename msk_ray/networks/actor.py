"""The policy."""

import math

import torch
from torch import Tensor, nn

from msk_ray.config.schema import ActorConfig
from msk_ray.networks.mlp import make_mlp


class Actor(nn.Module):
    """Action tanh(μ(obs) + σ·noise) with a state-independent σ, or tanh(μ(obs)) if deterministic."""

    def __init__(self, config: ActorConfig, obs_size: int, action_size: int, generator: torch.Generator) -> None:
        super().__init__()
        self.mean = make_mlp(config, obs_size, action_size, generator, config.output_gain)
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

    def sample(self, obs: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (..., A) for normalised observations (..., O) and noise (..., A), and −log π of each, shape (...).

        For a = tanh(u), u = μ + σn:  −log π(a) = Σ ½n² + log σ + ½ log 2π + log(1 − tanh² u)
        (Haarnoja et al. 2018, arXiv:1801.01290, appendix C). Differentiable in both results.
        """
        assert self.log_std is not None
        raw = self.mean(obs) + self.log_std.exp() * noise
        # log(1 − tanh² u) = 2 (log 2 − u − softplus(−2u)); this form stays finite where tanh² rounds to 1.
        squash = 2.0 * (math.log(2.0) - raw - nn.functional.softplus(-2.0 * raw))
        gaussian = 0.5 * noise.square() + self.log_std + 0.5 * math.log(2.0 * math.pi)
        return torch.tanh(raw), (gaussian + squash).sum(-1)
