"""The policy with the statistics of its observations."""

from torch import Tensor, nn

from msk_ray.networks.actor import Actor
from msk_ray.networks.normalizer import RunningMeanStd


class PolicyNetwork(nn.Module):
    """Raw observations (..., O) to deterministic actions (..., A), differentiable."""

    def __init__(self, actor: Actor, normalizer: RunningMeanStd) -> None:
        super().__init__()
        self.actor = actor
        self.normalizer = normalizer

    def forward(self, obs: Tensor) -> Tensor:
        action: Tensor = self.actor(self.normalizer.normalize(obs))
        return action

    def parts(self) -> dict[str, nn.Module]:
        """Its modules by name."""
        return dict(self.named_children())
