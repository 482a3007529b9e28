"""The critic fits what it is given."""

import pytest
import torch

from msk_ray.algorithms.shac.critic_fit import CriticFit
from msk_ray.config.schema import CriticConfig
from msk_ray.networks import Critic


def fit(passes: int, grad_norm: float | None = 1.0) -> tuple[Critic, float]:
    critic = Critic(CriticConfig(hidden=(32,), count=2), 3, torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(1)
    obs = torch.randn(256, 3, generator=generator)
    fit = CriticFit(critic, 1e-2, (0.9, 0.99), grad_norm)
    loss = fit.run(obs, obs[:, 0] ** 2, fit.draw_orders(256, passes, generator), 4)
    return critic, float(loss)


def test_the_loss_falls_and_both_networks_learn() -> None:
    _, first = fit(1)
    critic, last = fit(100)
    assert last < 0.05 * first
    obs = torch.randn(64, 3)
    assert ((critic(obs) - obs[:, 0] ** 2).square().mean(1) < 0.5).all()


def test_the_first_adam_step_is_the_learning_rate_long() -> None:
    critic = Critic(CriticConfig(hidden=()), 1, torch.Generator().manual_seed(0))
    before = [p.detach().clone() for p in critic.parameters()]
    obs = torch.ones(4, 1)
    order = torch.arange(4)[None]
    CriticFit(critic, 0.125, (0.9, 0.999), None).run(obs, torch.full((4,), 100.0), order, 1)
    # With bias correction Adam's first step is the rate in the direction of each entry's sign.
    moved = [(p - b).item() for p, b in zip(critic.parameters(), before, strict=True)]
    assert torch.allclose(torch.tensor(moved), torch.tensor([0.125, 0.125]), atol=1e-5)


def test_each_pass_sees_every_row_once_and_drops_what_fills_no_minibatch() -> None:
    critic = Critic(CriticConfig(hidden=(8,)), 1, torch.Generator().manual_seed(0))
    fit = CriticFit(critic, 1e-9, (0.9, 0.99), None)
    orders = fit.draw_orders(7, 3, torch.Generator().manual_seed(0))
    assert [sorted(order.tolist()) for order in orders] == [list(range(7))] * 3
    assert len({tuple(order.tolist()) for order in orders}) == 3
    obs = torch.randn(7, 1, generator=torch.Generator().manual_seed(2))
    targets = torch.arange(7.0)
    # At a rate that changes nothing, the last pass's loss is that of its first six rows.
    used = orders[-1][:6]
    expected = (critic(obs[used]) - targets[used]).square().mean()
    assert torch.isclose(fit.run(obs, targets, orders, 2), expected, rtol=1e-4)


def test_a_fit_that_has_settled_takes_no_further_steps() -> None:
    obs = torch.randn(64, 3, generator=torch.Generator().manual_seed(1))
    weights = {}
    for name, tolerance, passes in (("settled", 1e9, 20), ("five", None, 5), ("all", 1e-12, 20), ("plain", None, 20)):
        critic = Critic(CriticConfig(hidden=(8,)), 3, torch.Generator().manual_seed(0))
        fit = CriticFit(critic, 1e-2, (0.9, 0.99), 1.0, tolerance=tolerance)
        orders = torch.arange(64).repeat(passes, 1)
        fit.run(obs, obs[:, 0], orders, 4)
        weights[name] = torch.nn.utils.parameters_to_vector(critic.parameters())
    # Four changes are five passes.
    assert torch.equal(weights["settled"], weights["five"])
    assert torch.equal(weights["all"], weights["plain"])
    assert not torch.equal(weights["five"], weights["plain"])


@pytest.mark.parametrize("grad_norm", [1e-3, None])
def test_gradients_without_autograd_are_its_own(grad_norm: float | None) -> None:
    """Of two networks, whose norms are bounded apart, for rows that are no power of two."""
    generator = torch.Generator().manual_seed(1)
    obs, targets = torch.randn(30, 3, generator=generator), torch.randn(30, generator=generator)
    fitted = []
    for by_hand in (True, False):
        critic = Critic(CriticConfig(hidden=(8, 8), count=2), 3, torch.Generator().manual_seed(0))
        fit = CriticFit(critic, 1e-2, (0.7, 0.95), grad_norm)
        fit._passes = fit._passes if by_hand else None
        assert (fit._passes is not None) == by_hand
        loss = fit.run(obs, targets, fit.draw_orders(30, 3, torch.Generator().manual_seed(2)), 2)
        fitted.append([loss, *(p.detach() for p in critic.parameters())])
    torch.testing.assert_close(*fitted, rtol=1e-4, atol=1e-5)


def test_weight_decay_by_hand() -> None:
    critic = Critic(CriticConfig(hidden=()), 1, torch.Generator().manual_seed(0))
    before = [p.detach().clone() for p in critic.parameters()]
    fit = CriticFit(critic, 0.125, (0.9, 0.999), None, weight_decay=0.5)
    fit.run(torch.ones(4, 1), torch.full((4,), 100.0), torch.arange(4)[None], 1)
    # Adam's step of the rate, after a shrinkage by rate · decay = 1/16.
    for parameter, start in zip(critic.parameters(), before, strict=True):
        assert torch.allclose(parameter, 15 / 16 * start + 0.125, atol=1e-5)


def test_fused_layers_fit_alike() -> None:
    """Ten steps from the same start."""
    obs = torch.randn(64, 3, generator=torch.Generator().manual_seed(0))
    orders = torch.arange(64).expand(10, 64)
    fitted = []
    for fused in (False, True):
        critic = Critic(CriticConfig(hidden=(16, 8), count=2), 3, torch.Generator().manual_seed(1))
        assert critic.can_fuse
        fit = CriticFit(critic, 1e-2, (0.9, 0.99), 1.0)
        fit._passes, fit._values = None, critic.fused if fused else critic
        loss = fit.run(obs, obs[:, 0], orders, 1)
        fitted.append((critic(obs), loss))
    torch.testing.assert_close(*fitted, rtol=1e-3, atol=1e-4)
    assert not torch.equal(fitted[0][0], fitted[1][0])
