"""Layers one after the other and their derivatives, called one by one.

Autograd notes every operation of a network and takes its notes apart again. On a CPU that takes longer than the
arithmetic of a small network. Axes: N rows, I inputs and F features of a layer.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn

Kept = tuple[Tensor, ...]
"""What a layer's derivative needs of its forward pass."""

_ATEN: Any = torch.ops.aten
_elu_backward, _silu_backward = _ATEN.elu_backward.default, _ATEN.silu_backward.default
_relu_backward, _tanh_backward = _ATEN.threshold_backward.default, _ATEN.tanh_backward.default
_norm_backward = _ATEN.native_layer_norm_backward.default


class Layer(Protocol):
    """A layer of rows (N, I); `count` is the number of its parameters."""

    count: int

    def forward(self, x: Tensor, *parameters: Tensor) -> tuple[Tensor, Kept]:
        """Its output (N, F)."""

    def backward(self, kept: Kept, bar: Tensor, of_x: bool, into: Sequence[Tensor]) -> Tensor | None:
        """The gradient of its input for the output's cotangent, if that is wanted; writes those of its parameters."""


class _Linear:
    """x Wᵀ + b."""

    count = 2

    def __init__(self, _: nn.Module) -> None:
        pass

    def forward(self, x: Tensor, *parameters: Tensor) -> tuple[Tensor, Kept]:
        weight, bias = parameters
        return torch.addmm(bias, x, weight.t()), (x, weight)

    def backward(self, kept: Kept, bar: Tensor, of_x: bool, into: Sequence[Tensor]) -> Tensor | None:
        x, weight = kept
        if x.shape[1] < bar.shape[1]:  # the narrow side first: four times as fast for five inputs
            into[0].copy_((x.t() @ bar).t())
        else:
            torch.mm(bar.t(), x, out=into[0])
        torch.sum(bar, 0, out=into[1])
        return bar @ weight if of_x else None


class _Norm:
    """LayerNorm over the features."""

    count = 2

    def __init__(self, module: nn.Module) -> None:
        assert isinstance(module, nn.LayerNorm)
        self._shape, self._epsilon = list(module.normalized_shape), module.eps

    def forward(self, x: Tensor, *parameters: Tensor) -> tuple[Tensor, Kept]:
        gain, shift = parameters
        y, mean, scale = torch.native_layer_norm(x, self._shape, gain, shift, self._epsilon)
        return y, (x, mean, scale, gain, shift)

    def backward(self, kept: Kept, bar: Tensor, of_x: bool, into: Sequence[Tensor]) -> Tensor | None:
        x, mean, scale, gain, shift = kept
        found = _norm_backward(bar, x, self._shape, mean, scale, gain, shift, [of_x, True, True])
        into[0].copy_(found[1])
        into[1].copy_(found[2])
        x_bar: Tensor | None = found[0]
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

    def forward(self, x: Tensor, *_: Tensor) -> tuple[Tensor, Kept]:
        y = self._function(x)
        return y, (x, y)

    def backward(self, kept: Kept, bar: Tensor, of_x: bool, _: Sequence[Tensor]) -> Tensor | None:
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
    """The layers of a network, for rows on a CPU.

    Args:
        modules: linear layers and norms with their parameters, and activations, with torch's default constants.
    """

    def __init__(self, modules: Iterable[nn.Module]) -> None:
        self._layers = [_LAYERS[type(module)](module) for module in modules]

    def forward(self, x: Tensor, parameters: Sequence[Tensor]) -> tuple[Tensor, list[Kept]]:
        """The output (N, F) for rows (N, I), and what `backward` needs of each layer.

        Args:
            parameters: those of all layers, in their order.
        """
        kept, first = [], 0
        for layer in self._layers:
            x, own = layer.forward(x, *parameters[first : first + layer.count])
            kept.append(own)
            first += layer.count
        return x, kept

    def backward(self, kept: Sequence[Kept], bar: Tensor, into: Sequence[Tensor], *, of_x: bool) -> Tensor | None:
        """The gradient of the rows for the output's cotangent, if that is wanted; writes those of all parameters.

        Args:
            kept: what `forward` returned.
            bar: the cotangent (N, F).
            into: where the gradients of the parameters go, in their order, each of the parameter's shape.
        """
        below: Tensor | None = bar
        end = len(into)
        for k in reversed(range(len(self._layers))):
            assert below is not None
            layer = self._layers[k]
            below = layer.backward(kept[k], below, of_x or k > 0, into[end - layer.count : end])
            end -= layer.count
        return below
