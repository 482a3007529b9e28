"""Fit the critic to its targets, one minibatch at a time."""

import torch
from torch import Tensor, nn

from msk_ray.algorithms.shac.optimizer import RateAdam, clip, clip_flat, views_of
from msk_ray.group import ALONE, Group
from msk_ray.networks import Critic
from msk_ray.networks.layer_chain import Chain

_WINDOW = 4
"""Changes of the loss from pass to pass that count together."""


class CriticFit:
    """Adam on the mean squared error, with each network's gradient norm bounded.

    Args:
        critic: the networks to fit.
        learning_rate: initial rate; `optimizer.set_rate` changes it.
        betas: Adam's moment decays.
        grad_norm: bound on each network's gradient norm; None for no bound.
        weight_decay: decoupled weight decay; 0 for none.
        tolerance: change of the loss a pass, relative to it, below which no further step is taken; None: all steps.
        group: the processes that fit it together, each with its share of every minibatch.

    Attributes:
        optimizer: the critic's.
    """

    def __init__(
        self,
        critic: Critic,
        learning_rate: float,
        betas: tuple[float, float],
        grad_norm: float | None,
        *,
        weight_decay: float = 0.0,
        tolerance: float | None = None,
        group: Group = ALONE,
    ) -> None:
        device = next(critic.parameters()).device
        # Stored, because `parameters()` walks all submodules on every call.
        self._members = [list(member.parameters()) for member in critic.members]
        self._parameters = [parameter for member in self._members for parameter in member]
        self._values = critic.fused if device.type == "cuda" and critic.can_fuse else critic
        self._passes = [_Pass(member) for member in critic.members] if device.type == "cpu" else None
        self._grad_norm = grad_norm
        self._tolerance = tolerance
        self._group = group
        self.optimizer = RateAdam(self._parameters, learning_rate, betas, weight_decay)

    def draw_orders(self, rows: int, passes: int, generator: torch.Generator) -> Tensor:
        """A random order of the rows for each pass, (passes, rows)."""
        return torch.stack([torch.randperm(rows, generator=generator, device=generator.device) for _ in range(passes)])

    def run(self, obs: Tensor, targets: Tensor, orders: Tensor, batches: int) -> Tensor:
        """Pass over rows obs (N, O) and targets (N,) in each of the orders (passes, N), in `batches` minibatches.

        Rows that do not fill a minibatch are left out of a pass. In a group, all processes are given the same rows and
        orders. Returns the mean loss of the last pass made.
        """
        size = self._group.size * (obs.shape[0] // (batches * self._group.size))
        passes: list[Tensor] = []
        settled: Tensor | None = None
        for order in orders:
            minibatches = self._group.own(order[: batches * size].view(batches, size), dim=1)
            losses = [self._step(obs[picked], targets[picked], settled) for picked in minibatches]
            passes.append(torch.stack(losses).mean())
            if self._tolerance is not None:
                settled = self._settled(passes, settled)
                # A recorded fit cannot stop early: there, the remaining passes change nothing.
                if settled.device.type == "cpu" and settled:
                    break
        return passes[-1]

    def _settled(self, passes: list[Tensor], before: Tensor | None) -> Tensor:
        """Whether the loss has stopped changing, a bool scalar on the device; once true, it stays true."""
        assert self._tolerance is not None
        if len(passes) <= _WINDOW:
            return torch.zeros((), dtype=torch.bool, device=passes[-1].device)
        # The mean of the last changes is the difference of their ends, divided by their number.
        change = (passes[-1] - passes[-1 - _WINDOW]).abs() / _WINDOW
        settled = change < self._tolerance * passes[-1]
        return settled if before is None else settled | before

    @torch.no_grad()
    def _step(self, obs: Tensor, targets: Tensor, skip: Tensor | None) -> Tensor:
        find = self._by_autograd if self._passes is None else self._by_hand
        mean, gradients = find(obs, targets)
        self.optimizer.step_along(gradients, skip)
        return mean

    def _by_autograd(self, obs: Tensor, targets: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The loss of these rows, and the clipped gradient of each parameter."""
        with torch.enable_grad():
            loss = (self._values(obs) - targets).square().mean()
            gradients = list(torch.autograd.grad(loss, self._parameters))
        mean = loss.detach()
        self._group.mean([mean, *gradients])
        if self._grad_norm is None:
            return mean, gradients
        each = iter(gradients)
        clipped = [clip([next(each) for _ in member], self._grad_norm)[0] for member in self._members]
        return mean, [gradient for member in clipped for gradient in member]

    def _by_hand(self, obs: Tensor, targets: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The same by hand on a CPU, where autograd's bookkeeping takes longer than the arithmetic."""
        assert self._passes is not None
        loss = obs.new_zeros(())
        for member in self._passes:
            loss += member.run(obs, targets, 1.0 / len(self._passes))
        self._group.mean([loss, *(member.gradient for member in self._passes)])
        if self._grad_norm is not None:
            for member in self._passes:
                clip_flat(member.gradient, self._grad_norm)
        return loss, [part for member in self._passes for part in member.parts]


class _Pass:
    """Loss and gradient of one network on a CPU.

    Attributes:
        gradient: the last `run`'s gradient as one tensor (N,); `parts` are views of it by parameter.
    """

    def __init__(self, member: nn.Module) -> None:
        self._chain = Chain(member)
        parameters = self._chain.parameters
        self.gradient = torch.zeros(sum(parameter.numel() for parameter in parameters))
        self.parts = views_of(self.gradient, parameters)

    def run(self, obs: Tensor, targets: Tensor, weight: float) -> Tensor:
        """Mean squared error of these rows, times a weight."""
        values, kept = self._chain.forward(obs)
        error = values - targets[:, None]
        scale = weight / len(obs)
        loss = scale * error.square().sum()
        self._chain.backward(kept, error.mul_(2.0 * scale), self.parts)
        return loss
