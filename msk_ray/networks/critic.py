"""The value function."""

import torch
from torch import Tensor, nn

from msk_ray.config.schema import CriticConfig
from msk_ray.networks.mlp import fused_forward, make_mlp


class Critic(nn.Module):
    """One or two value networks of a normalised observation.

    Attributes:
        can_fuse: whether `fused` applies.
    """

    def __init__(self, config: CriticConfig, obs_size: int, generator: torch.Generator) -> None:
        super().__init__()
        self.can_fuse = config.activation == "elu"
        self.members = nn.ModuleList(make_mlp(config, obs_size, 1, generator) for _ in range(config.count))

    def forward(self, obs: Tensor) -> Tensor:
        """Values (C, ...) of each of the C networks for observations (..., O)."""
        return torch.stack([member(obs).squeeze(-1) for member in self.members])

    def fused(self, obs: Tensor) -> Tensor:
        """The same for observations (N, O), with fewer kernels; equal up to rounding. It saves time on a GPU only."""
        return torch.stack([fused_forward(member, obs).squeeze(-1) for member in self.members])

    def value(self, obs: Tensor) -> Tensor:
        """Value (...); with two networks, the smaller one."""
        return self(obs).amin(0)
