"""Fit the critic to its targets, one minibatch at a time."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import torch
from torch import Tensor

from msk_ray.algorithms.shac.optimizer import RateAdam, clip_rows, views_of
from msk_ray.group import ALONE, Group
from msk_ray.networks import BatchedCritic, Critic
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
        on_cpu = next(critic.parameters()).device.type == "cpu"
        self._gradient: _Gradient = _ByHand(critic, group) if on_cpu else _Batched(critic, group)
        self._grad_norm = grad_norm
        self._tolerance = tolerance
        self._group = group
        self.optimizer = RateAdam(critic.parameters(), learning_rate, betas, weight_decay)

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
        loss, flat = self._gradient(obs, targets)
        if self._grad_norm is not None:
            clip_rows(flat, self._grad_norm)
        self.optimizer.step_along(self._gradient.parts(flat), skip)
        return loss


class _Gradient(Protocol):
    """Loss and gradient of all C networks, with P parameters each."""

    def __call__(self, obs: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
        """The loss of these rows, averaged over networks and processes, and its gradient (C, P)."""

    def parts(self, flat: Tensor) -> list[Tensor]:
        """A gradient (C, P) as one tensor a parameter, in the order of the critic's parameters."""


@contextmanager
def tf32_products() -> Iterator[None]:
    """CUDA's matrix products round their inputs to TF32, 10 bits of mantissa, in this context. For the fit alone: its
    targets are noisy by much more, while the policy's gradient is not."""
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = True
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before


class _Batched:
    """All networks at once, by autograd, with `tf32_products`."""

    def __init__(self, critic: Critic, group: Group) -> None:
        self._batched = BatchedCritic(critic)
        self._group = group

    def __call__(self, obs: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad(), tf32_products():
            loss = (self._batched(obs) - targets).square().mean()
            gradients = torch.autograd.grad(loss, self._batched.parameters)
        mean, flat = loss.detach(), torch.cat([gradient.flatten(1) for gradient in gradients], dim=1)
        self._group.mean([mean, flat])
        return mean, flat

    def parts(self, flat: Tensor) -> list[Tensor]:
        like = [parameter[0] for parameter in self._batched.parameters]
        return [part for row in flat for part in views_of(row, like)]


class _ByHand:
    """One network after the other by hand, on a CPU, where autograd's bookkeeping takes longer than the arithmetic."""

    def __init__(self, critic: Critic, group: Group) -> None:
        self._chains = [Chain(member) for member in critic.members]
        self._group = group
        parameters = self._chains[0].parameters
        self._flat = torch.zeros(len(self._chains), sum(parameter.numel() for parameter in parameters))
        self._views = [views_of(row, parameters) for row in self._flat]

    def __call__(self, obs: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
        loss = obs.new_zeros(())
        scale = 1.0 / (len(self._chains) * len(obs))
        for chain, into in zip(self._chains, self._views, strict=True):
            values, kept = chain.forward(obs)
            error = values - targets[:, None]
            loss += scale * error.square().sum()
            chain.backward(kept, error.mul_(2.0 * scale), into)
        self._group.mean([loss, self._flat])
        return loss, self._flat

    def parts(self, flat: Tensor) -> list[Tensor]:
        return [part for views in self._views for part in views]
