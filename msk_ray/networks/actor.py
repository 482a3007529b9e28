"""The policy."""

import math

import torch
from torch import Tensor, nn

from msk_ray.config.schema import ActorConfig
from msk_ray.networks.mlp import make_mlp

_LOG_STD_RANGE = (-5.0, 2.0)
"""Bounds of log σ where σ depends on the observation, as in SAPO."""


class Actor(nn.Module):
    """Action tanh(μ(obs) + σ·noise), or tanh(μ(obs)) if deterministic.

    σ is the same for all observations, or log σ is a linear function of μ's last hidden layer, which starts at the same
    value everywhere.

    Attributes:
        log_std: log σ (A,) for all observations; None if σ depends on them.
    """

    def __init__(self, config: ActorConfig, obs_size: int, action_size: int, generator: torch.Generator) -> None:
        super().__init__()
        self.mean = make_mlp(config, obs_size, action_size, generator, config.output_gain)
        self.log_std = None if config.state_std else nn.Parameter(torch.full((action_size,), config.log_std))
        self.log_std_layer: nn.Linear | None = None
        if config.state_std:
            last = self.mean[-1]
            assert isinstance(last, nn.Linear)
            self.log_std_layer = nn.Linear(last.in_features, action_size)
            nn.init.zeros_(self.log_std_layer.weight)
            nn.init.constant_(self.log_std_layer.bias, config.log_std)

    def forward(self, obs: Tensor, noise: Tensor | None = None) -> Tensor:
        """Actions (..., A) in (-1, 1) for normalised observations (..., O).

        Args:
            noise: standard normal numbers (..., A), by reparametrisation; None for the deterministic action.
        """
        mean, log_std = self._gaussian(obs)
        if noise is not None:
            mean = mean + log_std.exp() * noise
        return torch.tanh(mean)

    def std(self, obs: Tensor) -> Tensor:
        """σ (A,) or (..., A), before tanh, for normalised observations (..., O)."""
        log_std = self._gaussian(obs)[1] if self.log_std is None else self.log_std
        return log_std.exp()

    def _gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """μ (..., A) and log σ, (A,) or (..., A)."""
        if self.log_std_layer is None:
            assert self.log_std is not None
            return self.mean(obs), self.log_std
        hidden = self.mean[:-1](obs)
        return self.mean[-1](hidden), self.log_std_layer(hidden).clamp(*_LOG_STD_RANGE)

    def sample(self, obs: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (..., A) for normalised observations (..., O) and noise (..., A), and −log π of each, shape (...).

        For a = tanh(u), u = μ + σn:  −log π(a) = Σ ½n² + log σ + ½ log 2π + log(1 − tanh² u)
        (Haarnoja et al. 2018, arXiv:1801.01290, appendix C). Differentiable in both results.
        """
        mean, log_std = self._gaussian(obs)
        raw = mean + log_std.exp() * noise
        # log(1 − tanh² u) = 2 (log 2 − u − softplus(−2u)); this form stays finite where tanh² rounds to 1.
        squash = 2.0 * (math.log(2.0) - raw - nn.functional.softplus(-2.0 * raw))
        gaussian = 0.5 * noise.square() + log_std + 0.5 * math.log(2.0 * math.pi)
        return torch.tanh(raw), (gaussian + squash).sum(-1)
