"""Network calls whose parameter gradients are computed together.

A rollout calls the network once per step. For each call, autograd multiplies small matrices for every parameter and
sums the results; on a CPU one product over all rows is faster.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from msk_ray.networks.layer_chain import Chain, SavedTensors
from msk_ray.networks.mlp import Mlp


class NetworkCalls:
    """Calls of a network with rows (W, I) on a CPU, each one autograd operation.

    A backward pass does not touch the parameters: call `add_gradients` after it.

    Args:
        network: the network, with its current parameters.
    """

    def __init__(self, network: Mlp) -> None:
        self._network = network
        self._chain = Chain(network)
        # Makes the operation differentiable: parameters are no inputs of it, and first observations need no gradient.
        self._anchor = torch.zeros((), requires_grad=True)
        self._kept: list[list[SavedTensors]] = []
        self._bars: dict[int, list[Tensor]] = {}

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Context in which calls of the network are recorded here."""
        self._network.instead = self
        try:
            yield
        finally:
            self._network.instead = None

    def __call__(self, x: Tensor) -> Tensor:
        """The network's output (W, F) for rows (W, I)."""
        y: Tensor = _Call.apply(self, x, self._anchor)
        return y

    def add_gradients(self) -> None:
        """Add the gradients of all calls that a backward pass has reached to the parameters' `grad`."""
        if not self._bars:
            return
        gradients = [torch.empty_like(parameter, requires_grad=False) for parameter in self._chain.parameters]
        calls = sorted(self._bars)
        with torch.no_grad():
            self._chain.add_up([self._kept[k] for k in calls], [self._bars[k] for k in calls], gradients)
        for parameter, gradient in zip(self._chain.parameters, gradients, strict=True):
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient

    def linear(self) -> Iterator[tuple[nn.Linear, list[Tensor], list[Tensor]]]:
        """Each linear layer, with its inputs (W, I) and output cotangents (W, F) in the calls reached so far."""
        calls = sorted(self._bars)
        for k, module in enumerate(self._chain.modules):
            if isinstance(module, nn.Linear):
                yield module, [self._kept[c][k][0] for c in calls], [self._bars[c][k] for c in calls]

    def _forward(self, x: Tensor) -> tuple[Tensor, int]:
        y, kept = self._chain.forward(x)
        self._kept.append(kept)
        return y, len(self._kept) - 1

    def _backward(self, call: int, bar: Tensor, of_x: bool) -> Tensor | None:
        x_bar, self._bars[call] = self._chain.pull(self._kept[call], bar, of_x)
        return x_bar


class _Call(torch.autograd.Function):
    """(calls, rows, a scalar with a gradient) to the network's output."""

    @staticmethod
    def forward(ctx: Any, calls: NetworkCalls, x: Tensor, _: Tensor) -> Tensor:
        y, ctx.call = calls._forward(x.detach())
        ctx.calls = calls
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        return None, ctx.calls._backward(ctx.call, bar, ctx.needs_input_grad[1]), None
