"""The critic fits what it is given."""

import pytest
import torch

from msk_ray.algorithms.shac.critic_fit import CriticFit, _Batched, _ByHand
from msk_ray.config.schema import CriticConfig
from msk_ray.group import ALONE
from msk_ray.networks import BatchedCritic, Critic


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
@pytest.mark.parametrize("activation", ["elu", "silu"])
def test_networks_in_one_batch_fit_as_one_after_the_other(activation: str, grad_norm: float | None) -> None:
    """Two networks whose norms are bounded apart: gradient of the first rows, and 30 steps of ten rows."""
    generator = torch.Generator().manual_seed(1)
    obs, targets = torch.randn(30, 3, generator=generator), torch.randn(30, generator=generator)
    orders = torch.stack([torch.randperm(30, generator=generator) for _ in range(10)])
    gradients, fitted = [], []
    for gradient in (_ByHand, _Batched):
        config = CriticConfig(hidden=(8, 5), count=2, activation=activation)
        critic = Critic(config, 3, torch.Generator().manual_seed(0))
        start = [p.detach().clone() for p in critic.parameters()]
        fit = CriticFit(critic, 1e-2, (0.7, 0.95), grad_norm)
        fit._gradient = gradient(critic, ALONE)
        with torch.no_grad():
            gradients.append([t.clone() for t in fit._gradient(obs[:10], targets[:10])])
        loss = fit.run(obs, targets, orders, 3)
        assert not any(map(torch.equal, start, critic.parameters()))
        fitted.append({"loss": loss, **critic.state_dict()})
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(*fitted, rtol=1e-5, atol=1e-6)


def test_products_of_a_fit_are_tf32_and_those_after_it_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    critic = Critic(CriticConfig(hidden=(8,), count=2), 3, torch.Generator().manual_seed(0))
    gradient = _Batched(critic, ALONE)
    matmul = torch.backends.cuda.matmul
    seen = []
    monkeypatch.setattr(gradient, "_batched", lambda obs: seen.append(matmul.allow_tf32) or 1 / 0)
    assert not matmul.allow_tf32
    with pytest.raises(ZeroDivisionError):
        gradient(torch.randn(5, 3), torch.randn(5))
    assert seen == [True]
    assert not matmul.allow_tf32


def test_a_batch_computes_what_its_networks_are_loaded_with() -> None:
    critic, other = (Critic(CriticConfig(hidden=(8,), count=2), 3, torch.Generator().manual_seed(k)) for k in (0, 1))
    batched = BatchedCritic(critic)
    critic.load_state_dict(other.state_dict())
    obs = torch.randn(5, 3)
    torch.testing.assert_close(batched(obs), other(obs))


def test_weight_decay_by_hand() -> None:
    critic = Critic(CriticConfig(hidden=()), 1, torch.Generator().manual_seed(0))
    before = [p.detach().clone() for p in critic.parameters()]
    fit = CriticFit(critic, 0.125, (0.9, 0.999), None, weight_decay=0.5)
    fit.run(torch.ones(4, 1), torch.full((4,), 100.0), torch.arange(4)[None], 1)
    # Adam's step of the rate, after a shrinkage by rate · decay = 1/16.
    for parameter, start in zip(critic.parameters(), before, strict=True):
        assert torch.allclose(parameter, 15 / 16 * start + 0.125, atol=1e-5)
