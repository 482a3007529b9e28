"""How much of a policy gradient is signal: do the two halves of the batch agree?"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from msk_ray.group import ALONE, Group
from msk_ray.networks.network_calls import NetworkCalls


class HalfBatchCosine:
    """Splits the gradient of one backward pass into the parts of the two halves of the worlds.

    A linear layer's weight gradient is the sum over steps and worlds of (output cotangent) ⊗ (input). Both are
    available during the pass, so each half's gradient costs one matrix product per layer afterwards, not another
    pass.

    Args:
        network: its linear layers are observed; inputs have shape (W, n) with the worlds first.
        group: the processes that share the worlds.
        calls: recorders of network calls, for layers that hooks do not see.
    """

    def __init__(self, network: nn.Module, group: Group = ALONE, calls: Sequence[NetworkCalls] = ()) -> None:
        self._group = group
        self._calls = calls
        self._layers = [m for m in network.modules() if isinstance(m, nn.Linear)]
        self._inputs: dict[nn.Module, list[Tensor]] = {m: [] for m in self._layers}
        self._cotangents: dict[nn.Module, dict[int, Tensor]] = {m: {} for m in self._layers}

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Context in which the network's calls are observed."""
        handles = [m.register_forward_hook(self._saw) for m in self._layers]
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()

    def cosine(self) -> Tensor:
        """Cosine between the halves' weight gradients, a scalar: 1 all signal, about 0 all noise.

        With noise of equal size in both halves, |signal|² : |noise|² of the whole gradient is 2c : (1 − c).
        Call it after the backward pass. NaN where a half's gradient is zero, or for fewer than two worlds.
        """
        halves = []
        for inputs, outputs in self._seen():
            halves.append(
                [
                    outputs[:, part].flatten(0, 1).T @ inputs[:, part].flatten(0, 1)
                    for part in self._parts(inputs.shape[1])
                ]
            )
        self._group.mean([gradient for of_layer in halves for gradient in of_layer])  # their length does not matter
        products = [torch.stack([(a * b).sum(), a.square().sum(), b.square().sum()]) for a, b in halves]
        ab, aa, bb = torch.stack(products).sum(0)
        return ab * torch.rsqrt(aa * bb)

    def _seen(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Inputs (H, W, I) of the layers and cotangents (H, W, F) of their outputs."""
        elsewhere = {layer: seen for calls in self._calls for layer, *seen in calls.linear()}
        for layer in self._layers:
            if layer in elsewhere:
                inputs, outputs = elsewhere[layer]
            else:
                steps = sorted(self._cotangents[layer])
                inputs = [self._inputs[layer][i] for i in steps]
                outputs = [self._cotangents[layer][i] for i in steps]
            yield torch.stack(inputs), torch.stack(outputs)

    def _parts(self, nworld: int) -> tuple[slice, slice]:
        """Which of this process's worlds belong to the first and to the second half of all worlds."""
        first, half = self._group.rank * nworld, self._group.size * nworld // 2
        middle, end = (min(max(bound - first, 0), nworld) for bound in (half, 2 * half))
        return slice(0, middle), slice(middle, end)

    def _saw(self, layer: nn.Module, inputs: tuple[Any, ...], output: Tensor) -> None:
        if output.requires_grad:
            index = len(self._inputs[layer])
            self._inputs[layer].append(inputs[0].detach())
            output.register_hook(partial(self._cotangents[layer].__setitem__, index))
