"""Sequential layers with explicit forward and backward calls.

On a CPU, autograd's bookkeeping for each operation takes longer than the arithmetic of a small network.

Axes: N rows, I inputs and F features of a layer.
"""

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any, Protocol

import torch
from torch import Tensor, nn

SavedTensors = tuple[Tensor, ...]
"""What a layer keeps of its forward pass for its derivative, with a row for each input row."""

_ATEN: Any = torch.ops.aten
_elu_backward, _silu_backward = _ATEN.elu_backward.default, _ATEN.silu_backward.default
_relu_backward, _tanh_backward = _ATEN.threshold_backward.default, _ATEN.tanh_backward.default
_norm_backward = _ATEN.native_layer_norm_backward.default


class Layer(Protocol):
    """A layer of rows (N, I); `count` is the number of its parameters."""

    count: int

    def forward(self, x: Tensor, *parameters: Tensor) -> tuple[Tensor, SavedTensors]:
        """Its output (N, F)."""

    def backward(
        self, kept: SavedTensors, parameters: Sequence[Tensor], bar: Tensor, of_x: bool, into: Sequence[Tensor] | None
    ) -> Tensor | None:
        """The gradient of its input for the output's cotangent, None unless `of_x`; writes its parameters' gradients
        into `into`, unless that is None."""


class _Linear:
    """x Wᵀ + b."""

    count = 2

    def __init__(self, _: nn.Module) -> None:
        pass

    def forward(self, x: Tensor, *parameters: Tensor) -> tuple[Tensor, SavedTensors]:
        weight, bias = parameters
        return torch.addmm(bias, x, weight.t()), (x,)

    def backward(
        self, kept: SavedTensors, parameters: Sequence[Tensor], bar: Tensor, of_x: bool, into: Sequence[Tensor] | None
    ) -> Tensor | None:
        (x,) = kept
        if into is not None:
            if x.shape[1] < bar.shape[1]:  # the narrow side first: four times as fast for five inputs
                into[0].copy_((x.t() @ bar).t())
            else:
                torch.mm(bar.t(), x, out=into[0])
            torch.sum(bar, 0, out=into[1])
        return bar @ parameters[0] if of_x else None


class _Norm:
    """LayerNorm over the features."""

    count = 2

    def __init__(self, module: nn.Module) -> None:
        assert isinstance(module, nn.LayerNorm)
        self._shape, self._epsilon = list(module.normalized_shape), module.eps

    def forward(self, x: Tensor, *parameters: Tensor) -> tuple[Tensor, SavedTensors]:
        gain, shift = parameters
        y, mean, scale = torch.native_layer_norm(x, self._shape, gain, shift, self._epsilon)
        return y, (x, mean, scale)

    def backward(
        self, kept: SavedTensors, parameters: Sequence[Tensor], bar: Tensor, of_x: bool, into: Sequence[Tensor] | None
    ) -> Tensor | None:
        x, mean, scale = kept
        wanted = [of_x, into is not None, into is not None]
        gradients = _norm_backward(bar, x, self._shape, mean, scale, *parameters, wanted)
        if into is not None:
            into[0].copy_(gradients[1])
            into[1].copy_(gradients[2])
        x_bar: Tensor | None = gradients[0]
        return x_bar


class _Activation:
    """A function of each element.

    Args:
        function: x to y.
        slope: cotangent of y, x and y to the gradient of x.
    """

    count = 0

    def __init__(self, function: Callable[[Tensor], Tensor], slope: Callable[[Tensor, Tensor, Tensor], Tensor]) -> None:
        self._function, self._slope = function, slope

    def forward(self, x: Tensor, *_: Tensor) -> tuple[Tensor, SavedTensors]:
        y = self._function(x)
        return y, (x, y)

    def backward(
        self, kept: SavedTensors, parameters: Sequence[Tensor], bar: Tensor, of_x: bool, into: Sequence[Tensor] | None
    ) -> Tensor | None:
        return self._slope(bar, *kept) if of_x else None


def _elu(_: nn.Module) -> Layer:
    # From y, which takes no exponential: for y < 0 the slope is y + 1.
    return _Activation(nn.functional.elu, lambda bar, _, y: _elu_backward(bar, 1.0, 1.0, 1.0, True, y))


def _silu(_: nn.Module) -> Layer:
    return _Activation(nn.functional.silu, lambda bar, x, _: _silu_backward(bar, x))


def _relu(_: nn.Module) -> Layer:
    return _Activation(torch.relu, lambda bar, x, _: _relu_backward(bar, x, 0.0))


def _tanh(_: nn.Module) -> Layer:
    return _Activation(torch.tanh, lambda bar, _, y: _tanh_backward(bar, y))


_LAYERS: dict[type[nn.Module], Callable[[nn.Module], Layer]] = {
    nn.Linear: _Linear,
    nn.LayerNorm: _Norm,
    nn.ELU: _elu,
    nn.SiLU: _silu,
    nn.ReLU: _relu,
    nn.Tanh: _tanh,
}


class Chain:
    """The layers of a network, for rows on a CPU, with its current parameters.

    Args:
        network: linear layers, norms and activations, with torch's default constants.

    Attributes:
        parameters: the network's, in their order.
        modules: its layers.
    """

    def __init__(self, network: nn.Module) -> None:
        self.modules = list(network.children())
        self.parameters = list(network.parameters())
        self._layers = [_LAYERS[type(module)](module) for module in self.modules]
        ends = list(accumulate((layer.count for layer in self._layers), initial=0))
        self._own = [slice(*ends[k : k + 2]) for k in range(len(self._layers))]

    def forward(self, x: Tensor) -> tuple[Tensor, list[SavedTensors]]:
        """The output (N, F) for rows (N, I), and what each layer keeps for `backward`."""
        kept = []
        for layer, own in zip(self._layers, self._own, strict=True):
            x, of_layer = layer.forward(x, *self.parameters[own])
            kept.append(of_layer)
        return x, kept

    def backward(self, kept: Sequence[SavedTensors], bar: Tensor, into: Sequence[Tensor]) -> None:
        """Write the gradients of all parameters for the output's cotangent.

        Args:
            kept: what `forward` returned.
            bar: the cotangent (N, F).
            into: where to write them, in the parameters' order and shapes.
        """
        below: Tensor | None = bar
        for k in reversed(range(len(self._layers))):
            own = self._own[k]
            assert below is not None
            below = self._layers[k].backward(kept[k], self.parameters[own], below, k > 0, into[own])

    def pull(self, kept: Sequence[SavedTensors], bar: Tensor, of_x: bool) -> tuple[Tensor | None, list[Tensor]]:
        """The gradient of the rows, None unless `of_x`, and the cotangents of all layers' outputs."""
        bars = [bar]
        for k in reversed(range(1, len(self._layers))):
            below = self._layers[k].backward(kept[k], self.parameters[self._own[k]], bars[-1], True, None)
            assert below is not None
            bars.append(below)
        x_bar = self._layers[0].backward(kept[0], self.parameters[self._own[0]], bars[-1], of_x, None)
        return x_bar, bars[::-1]

    def add_up(
        self, kept: Sequence[Sequence[SavedTensors]], bars: Sequence[Sequence[Tensor]], into: Sequence[Tensor]
    ) -> None:
        """Write the gradients of all parameters, summed over calls.

        Args:
            kept: what `forward` returned in each call.
            bars: the cotangents that `pull` returned for it.
            into: where to write them.
        """
        for k, (layer, own) in enumerate(zip(self._layers, self._own, strict=True)):
            if layer.count:
                rows = tuple(map(torch.cat, zip(*(of_call[k] for of_call in kept), strict=True)))
                bar = torch.cat([of_call[k] for of_call in bars])
                layer.backward(rows, self.parameters[own], bar, False, into[own])
