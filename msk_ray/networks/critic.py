"""The value function."""

import torch
from torch import Tensor, nn

from msk_ray.config.schema import CriticConfig
from msk_ray.networks.mlp import Mlp, batched_forward, make_mlp


class Critic(nn.Module):
    """One or two value networks of a normalised observation."""

    def __init__(self, config: CriticConfig, obs_size: int, generator: torch.Generator) -> None:
        super().__init__()
        self.members = nn.ModuleList(make_mlp(config, obs_size, 1, generator) for _ in range(config.count))

    def forward(self, obs: Tensor) -> Tensor:
        """Values (C, ...) of each of the C networks for observations (..., O)."""
        return torch.stack([member(obs).squeeze(-1) for member in self.members])

    def value(self, obs: Tensor) -> Tensor:
        """Value (...); with two networks, the smaller one."""
        return self(obs).amin(0)


class BatchedCritic:
    """A critic whose networks are computed together, equal up to rounding; it saves time on a GPU only.

    Args:
        critic: the networks, on their device. Their parameters become views of `parameters`.

    Attributes:
        parameters: each parameter of all C networks in one tensor (C, ...), with a gradient.
    """

    def __init__(self, critic: Critic) -> None:
        member = critic.members[0]
        assert isinstance(member, Mlp)
        self._network = member
        self.parameters: list[Tensor] = []
        for each in zip(*(member.parameters() for member in critic.members), strict=True):
            together = torch.stack([parameter.detach() for parameter in each])
            for parameter, part in zip(each, together, strict=True):
                parameter.data = part
            self.parameters.append(together.requires_grad_())

    def __call__(self, obs: Tensor) -> Tensor:
        """Values (C, N) of each network for observations (N, O)."""
        return batched_forward(self._network, self.parameters, obs).squeeze(-1)
