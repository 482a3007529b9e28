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


def test_a_noise_scale_that_depends_on_the_observation_starts_the_same_everywhere() -> None:
    actor = Actor(ActorConfig(hidden=(8,), log_std=-0.5, state_std=True), 4, 2, torch.Generator().manual_seed(0))
    plain = Actor(ActorConfig(hidden=(8,), log_std=-0.5), 4, 2, torch.Generator().manual_seed(0))
    obs, noise = 0.5 * torch.randn(6, 4), 0.5 * torch.randn(6, 2)
    assert torch.equal(actor.std(obs), plain.std(obs).expand(6, 2))
    assert torch.equal(actor(obs, noise), plain(obs, noise))
    assert torch.equal(actor(obs), plain(obs))
    assert actor.log_std is None
    torch.nn.init.normal_(actor.log_std_layer.weight, std=0.1)
    std = actor.std(obs)
    assert std.std(0).min() > 0
    action, neg_log_prob = actor.sample(obs, noise)
    assert torch.equal(action, actor(obs, noise))
    squashed = torch.distributions.TransformedDistribution(
        torch.distributions.Normal(actor.mean(obs), std), [torch.distributions.transforms.TanhTransform()]
    )
    torch.testing.assert_close(neg_log_prob, -squashed.log_prob(action).sum(-1), rtol=1e-3, atol=1e-4)
    torch.nn.init.constant_(actor.log_std_layer.bias, 9.0)
    torch.nn.init.zeros_(actor.log_std_layer.weight)
    assert actor.std(obs).log().max().item() == 2.0, "SAPO's bound"


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
