"""Fit the critic to its targets, one minibatch at a time."""

import torch
from torch import Tensor, nn

from msk_ray.algorithms.shac.optimizer import RateAdam
from msk_ray.networks import Critic


class CriticFit:
    """Adam on the mean squared error, with each network's gradient norm bounded.

    Args:
        critic: the networks to fit.
        learning_rate: initial rate; `optimizer.set_rate` changes it.
        betas: Adam's moment decays.
        grad_norm: bound on each network's gradient norm; None for no bound.

    Attributes:
        optimizer: the critic's.
    """

    def __init__(
        self, critic: Critic, learning_rate: float, betas: tuple[float, float], grad_norm: float | None
    ) -> None:
        self._critic = critic
        self._grad_norm = grad_norm
        self.optimizer = RateAdam(critic.parameters(), learning_rate, betas)

    def draw_orders(self, rows: int, passes: int, generator: torch.Generator) -> Tensor:
        """A random order of the rows for each pass, (passes, rows)."""
        return torch.stack([torch.randperm(rows, generator=generator, device=generator.device) for _ in range(passes)])

    def run(self, obs: Tensor, targets: Tensor, orders: Tensor, batches: int) -> Tensor:
        """Pass over rows obs (N, O) and targets (N,) in each of the orders (passes, N), in `batches` minibatches.

        Rows that do not fill a minibatch are left out of a pass. Returns the mean loss of the last pass.
        """
        size = obs.shape[0] // batches
        losses: list[Tensor] = []
        for order in orders:
            losses = [
                self._step(obs[picked], targets[picked]) for picked in order[: batches * size].view(batches, size)
            ]
        return torch.stack(losses).mean()

    def _step(self, obs: Tensor, targets: Tensor) -> Tensor:
        loss = (self._critic(obs) - targets).square().mean()
        self.optimizer.optimizer.zero_grad()
        loss.backward()
        if self._grad_norm is not None:
            for member in self._critic.members:
                nn.utils.clip_grad_norm_(member.parameters(), self._grad_norm)
        self.optimizer.step()
        return loss.detach()
