"""Layers called one by one: torch's outputs and gradients."""

import pytest
import torch

from msk_ray.config.schema import CriticConfig
from msk_ray.networks.layer_chain import Chain
from msk_ray.networks.mlp import make_mlp


@pytest.mark.parametrize("activation", ["elu", "silu", "relu", "tanh"])
def test_gradients_are_those_of_autograd(activation: str) -> None:
    generator = torch.Generator().manual_seed(0)
    config = CriticConfig(hidden=(7, 4), activation=activation)
    network = make_mlp(config, 3, 2, generator).double()
    with torch.no_grad():
        for parameter in network.parameters():  # biases begin at zero, and gains of norms at one
            parameter += 0.3 * torch.randn(parameter.shape, generator=generator)
    x = torch.randn(9, 3, generator=generator).double().requires_grad_()
    bar = torch.randn(9, 2, generator=generator).double()
    parameters = list(network.parameters())
    expected = network(x)
    gradients = torch.autograd.grad(expected, [x, *parameters], bar)
    chain = Chain(network)
    found, summed = ([torch.full_like(p, torch.nan, requires_grad=False) for p in parameters] for _ in range(2))
    with torch.no_grad():
        y, kept = chain.forward(x)
        chain.backward(kept, bar, found)
        x_bar, bars = chain.pull(kept, bar, of_x=True)
        assert chain.pull(kept, bar, of_x=False)[0] is None
        chain.add_up([kept, kept], [bars, bars], summed)
    torch.testing.assert_close(y, expected)
    torch.testing.assert_close([x_bar, *found], list(gradients))
    torch.testing.assert_close(summed, [2.0 * gradient for gradient in found])
