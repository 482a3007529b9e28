"""The multilayer perceptron that both networks use."""

from collections.abc import Callable, Sequence
from itertools import islice, pairwise

import torch
from torch import Tensor, nn

from msk_ray.config import NetworkConfig
from msk_ray.networks.hidden_layer import hidden_layer

_ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "silu": nn.SiLU, "relu": nn.ReLU, "tanh": nn.Tanh}


class Mlp(nn.Sequential):
    """Sequential layers.

    Attributes:
        instead: if set, called instead of the layers.
    """

    instead: Callable[[Tensor], Tensor] | None = None

    def forward(self, x: Tensor) -> Tensor:
        """Outputs (..., F) for inputs (..., I)."""
        out: Tensor = super().forward(x) if self.instead is None else self.instead(x)
        return out


def make_mlp(
    config: NetworkConfig, inputs: int, outputs: int, generator: torch.Generator, output_gain: float = 1.0
) -> Mlp:
    """Linear, activation and LayerNorm per hidden layer; a linear last layer.

    Weights are orthogonal, drawn from `generator`, with gain √2 in hidden layers and `output_gain` in the last; biases
    are zero.
    """
    layers: list[nn.Module] = []
    sizes = (inputs, *config.hidden)
    for fan_in, fan_out in pairwise(sizes):
        linear = _linear(fan_in, fan_out, 2**0.5, generator)
        layers += [linear, _ACTIVATIONS[config.activation](), nn.LayerNorm(fan_out)]
    layers.append(_linear(sizes[-1], outputs, output_gain, generator))
    return Mlp(*layers)


def batched_forward(network: Mlp, parameters: Sequence[Tensor], x: Tensor) -> Tensor:
    """Outputs (C, N, F) of C networks of `make_mlp` for rows (N, I), all at once; equal to theirs up to rounding.

    Args:
        network: one of them.
        parameters: their parameters (C, ...), in the order of `network.parameters()`.
        x: the rows.
    """
    values = iter(parameters)
    x = x.expand(len(parameters[0]), *x.shape)
    *hidden, _ = network
    for activation, norm in zip(hidden[1::3], hidden[2::3], strict=True):
        assert isinstance(norm, nn.LayerNorm)
        weight, bias, gain, shift = islice(values, 4)
        if isinstance(activation, nn.ELU):
            x = hidden_layer(x, weight, bias, gain, shift, norm.eps)
        else:
            active = activation(torch.baddbmm(bias[:, None], x, weight.mT))
            x = nn.functional.layer_norm(active, norm.normalized_shape, eps=norm.eps) * gain[:, None] + shift[:, None]
    weight, bias = values
    return torch.baddbmm(bias[:, None], x, weight.mT)


def _linear(fan_in: int, fan_out: int, gain: float, generator: torch.Generator) -> nn.Linear:
    layer = nn.Linear(fan_in, fan_out)
    nn.init.orthogonal_(layer.weight, gain=gain, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer
