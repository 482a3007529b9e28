"""The critic fits what it is given."""

import torch

from msk_ray.algorithms.shac.critic_fit import CriticFit
from msk_ray.config.schema import CriticConfig
from msk_ray.networks import Critic


def fit(passes: int, grad_norm: float | None = 1.0) -> tuple[Critic, float]:
    critic = Critic(CriticConfig(hidden=(32,), count=2), 3, torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(1)
    obs = torch.randn(256, 3, generator=generator)
    loss = CriticFit(critic, 1e-2, (0.9, 0.99), grad_norm).run(obs, obs[:, 0] ** 2, passes, 4, generator)
    return critic, float(loss)


def test_the_loss_falls_and_both_networks_learn() -> None:
    _, first = fit(1)
    critic, last = fit(100)
    assert last < 0.05 * first
    obs = torch.randn(64, 3)
    assert ((critic(obs) - obs[:, 0] ** 2).square().mean(1) < 0.5).all()


def test_the_first_adam_step_is_the_learning_rate_long() -> None:
    critic = Critic(CriticConfig(hidden=(), layer_norm=False), 1, torch.Generator().manual_seed(0))
    before = [p.detach().clone() for p in critic.parameters()]
    obs = torch.ones(4, 1)
    CriticFit(critic, 0.125, (0.9, 0.999), None).run(obs, torch.full((4,), 100.0), 1, 1, torch.Generator())
    # With bias correction Adam's first step is the rate in the direction of each entry's sign.
    moved = [(p - b).item() for p, b in zip(critic.parameters(), before, strict=True)]
    assert torch.allclose(torch.tensor(moved), torch.tensor([0.125, 0.125]), atol=1e-5)
