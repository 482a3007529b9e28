"""Networks and running statistics."""

import torch

from msk_ray.config.schema import ActorConfig, CriticConfig
from msk_ray.networks import Actor, Critic, RunningMeanStd


def test_running_statistics_equal_those_of_all_rows_together() -> None:
    torch.manual_seed(0)
    rows = torch.randn(1000, 3) * torch.tensor([1.0, 5.0, 0.1]) + torch.tensor([0.0, 100.0, -3.0])
    running = RunningMeanStd((3,))
    for part in rows.split([10, 490, 500]):
        running.update(part)
    assert torch.allclose(running.mean, rows.mean(0), rtol=1e-4)
    assert torch.allclose(running.var, rows.var(0, unbiased=False), rtol=1e-3)
    assert torch.allclose(running.normalize(rows).std(0, unbiased=False), torch.ones(3), atol=1e-3)


def test_actions_are_bounded_and_differentiable_through_the_noise_scale() -> None:
    actor = Actor(ActorConfig(hidden=(8,), log_std=0.5), 4, 2, torch.Generator().manual_seed(0))
    obs = torch.randn(16, 4)
    action = actor(obs, torch.randn(16, 2))
    assert action.abs().max() < 1
    action.sum().backward()
    assert actor.log_std.grad.abs().sum() > 0
    assert torch.equal(actor(obs), actor(obs)), "without noise the policy is deterministic"


def test_a_deterministic_actor_has_no_noise_scale() -> None:
    actor = Actor(ActorConfig(hidden=(8,), stochastic=False), 4, 2, torch.Generator().manual_seed(0))
    assert actor.log_std is None
    obs = torch.randn(5, 4)
    assert torch.equal(actor(obs, torch.randn(5, 2)), actor(obs))


def test_the_smaller_of_two_critics_is_used() -> None:
    critic = Critic(CriticConfig(hidden=(8,), count=2), 4, torch.Generator().manual_seed(0))
    obs = torch.randn(7, 4)
    both = critic(obs)
    assert both.shape == (2, 7)
    assert torch.equal(critic.value(obs), torch.minimum(both[0], both[1]))
    assert not torch.equal(both[0], both[1])


def test_the_same_seed_gives_the_same_network() -> None:
    make = lambda seed: Actor(ActorConfig(), 4, 2, torch.Generator().manual_seed(seed)).mean[0].weight  # noqa: E731
    assert torch.equal(make(3), make(3))
    assert not torch.equal(make(3), make(4))


def test_a_small_output_gain_starts_near_rest() -> None:
    obs = torch.randn(64, 6)
    sizes = {}
    for gain in (1.0, 0.01):
        actor = Actor(ActorConfig(hidden=(32,), output_gain=gain), 6, 3, torch.Generator().manual_seed(0))
        sizes[gain] = torch.atanh(actor(obs)).norm().item()
    assert abs(sizes[0.01] / sizes[1.0] - 0.01) < 1e-4
