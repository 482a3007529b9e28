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

    def backward(self, kept: Kept, bar: Tensor, of_x: bool) -> tuple[Tensor | None, Kept]:
        """Gradients of its input, if that is wanted, and of its parameters, for the output's cotangent."""


class _Linear:
    """x Wᵀ + b."""

    count = 2

    def __init__(self, _: nn.Module) -> None:
        pass

    def forward(self, x: Tensor, *parameters: Tensor) -> tuple[Tensor, Kept]:
        weight, bias = parameters
        return torch.addmm(bias, x, weight.t()), (x, weight)

    def backward(self, kept: Kept, bar: Tensor, of_x: bool) -> tuple[Tensor | None, Kept]:
        x, weight = kept
        # The product of the narrow side first: four times as fast for five inputs as its transpose.
        return bar @ weight if of_x else None, ((x.t() @ bar).t(), bar.sum(0))


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

    def backward(self, kept: Kept, bar: Tensor, of_x: bool) -> tuple[Tensor | None, Kept]:
        x, mean, scale, gain, shift = kept
        x_bar, *found = _norm_backward(bar, x, self._shape, mean, scale, gain, shift, [of_x, True, True])
        return x_bar, tuple(found)


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

    def backward(self, kept: Kept, bar: Tensor, of_x: bool) -> tuple[Tensor | None, Kept]:
        return self._slope(bar, *kept) if of_x else None, ()


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

    def backward(self, kept: Sequence[Kept], bar: Tensor, *, of_x: bool) -> tuple[Tensor | None, list[Tensor]]:
        """Gradients of the rows, if that is wanted, and of all parameters in their order, for the output's cotangent.

        Args:
            kept: what `forward` returned.
            bar: the cotangent (N, F).
        """
        found: list[Kept] = []
        below: Tensor | None = bar
        for k in reversed(range(len(self._layers))):
            assert below is not None
            below, own = self._layers[k].backward(kept[k], below, of_x or k > 0)
            found.append(own)
        return below, [gradient for own in reversed(found) for gradient in own]
