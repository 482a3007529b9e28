"""A hidden layer of few kernels: torch's layers, gradients included."""

import pytest
import torch
from torch import nn

from msk_ray.networks.hidden_layer import hidden_layer

DEVICES = ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("rows", "features"), [(130, 33), (1, 5), (304, 200)])
def test_it_is_elu_and_layer_norm_of_a_linear_layer(rows: int, features: int, device: str) -> None:
    """Of two networks, in float64 by torch; rows that fill no chunk, and more features than a block has threads."""
    torch.manual_seed(0)
    shapes = [(rows, 7), (features, 7), (features,), (features,), (features,)]
    inputs = [torch.randn(2, *shape) for shape in shapes]
    weights = torch.randn(2, rows, features)
    exact = [t.double().requires_grad_() for t in inputs]
    layers = []
    for x, weight, bias, gain, shift in zip(*exact, strict=True):
        active = nn.functional.elu(nn.functional.linear(x, weight, bias))
        layers.append(nn.functional.layer_norm(active, (features,), gain, shift, 1e-5))
    expected = torch.stack(layers)
    gradients = torch.autograd.grad((expected * weights).sum(), exact)
    own = [t.to(device).requires_grad_() for t in inputs]
    found = hidden_layer(*own, 1e-5)
    torch.testing.assert_close(found.cpu().double(), expected, rtol=1e-4, atol=1e-4)
    for a, b in zip(torch.autograd.grad((found * weights.to(device)).sum(), own), gradients, strict=True):
        torch.testing.assert_close(a.cpu().double(), b, rtol=1e-3, atol=1e-4 * float(b.abs().max()))


def test_inputs_without_gradients_have_none() -> None:
    shapes = [(4, 3), (5, 3), (5,), (5,), (5,)]
    inputs = [torch.randn(1, *shape) for shape in shapes]
    inputs[1].requires_grad_()
    (found,) = torch.autograd.grad(hidden_layer(*inputs, 1e-5).square().sum(), inputs[1:2])
    assert found.shape == (1, 5, 3)
    assert not hidden_layer(*(t.detach() for t in inputs), 1e-5).requires_grad


def test_what_is_not_a_number_stays_so_in_its_row() -> None:
    x = torch.ones(1, 3, 4)
    x[0, 1, 2] = torch.nan
    found = hidden_layer(x, torch.eye(5, 4)[None], torch.zeros(1, 5), torch.ones(1, 5), torch.zeros(1, 5), 1e-5)[0]
    assert found.isnan().all(1).tolist() == [False, True, False]
    assert found[[0, 2]].isfinite().all()
