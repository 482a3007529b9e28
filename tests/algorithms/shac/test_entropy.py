import math

import pytest
import torch

from msk_ray.algorithms.shac.entropy import EntropyBonus
from msk_ray.config import EntropyConfig
from msk_ray.config.schema import ActorConfig
from msk_ray.networks import Actor


def test_neg_log_prob_is_the_negative_log_density_of_the_squashed_gaussian() -> None:
    actor = Actor(ActorConfig(hidden=(4,), log_std=math.log(0.5)), 3, 2, torch.Generator().manual_seed(0))
    obs, noise = torch.randn(6, 3), torch.randn(6, 2)
    action, neg_log_prob = actor.sample(obs, noise)
    torch.testing.assert_close(action, actor(obs, noise))
    # Independently: torch's own transformed distribution.
    base = torch.distributions.Normal(actor.mean(obs), 0.5)
    squashed = torch.distributions.TransformedDistribution(base, [torch.distributions.transforms.TanhTransform()])
    torch.testing.assert_close(neg_log_prob, -squashed.log_prob(action).sum(-1), rtol=1e-3, atol=1e-4)


def test_neg_log_prob_is_finite_where_the_action_saturates() -> None:
    actor = Actor(ActorConfig(hidden=(4,), log_std=3.0), 3, 2, torch.Generator().manual_seed(0))
    _action, neg_log_prob = actor.sample(torch.zeros(1, 3), torch.full((1, 2), 4.0))
    # u = 4 e³ = 80.3: log(1 − tanh² u) ≈ log 4 − 2u
    expected = 2 * (8.0 + 3.0 + 0.5 * math.log(2 * math.pi) + math.log(4.0) - 2 * 4 * math.exp(3.0))
    assert float(neg_log_prob.detach()) == pytest.approx(expected, rel=1e-3)


def test_a_normalized_bonus_by_hand() -> None:
    bonus = EntropyBonus(EntropyConfig(coefficient=0.5, target=-0.5, normalize=True), 4)
    # |T| = 2: (−2 + 2) / 4 = 0, (2 + 2) / 4 = 1, (0 + 2) / 4 = 1/2
    assert bonus.bonus(torch.tensor([-2.0, 2.0, 0.0])).tolist() == [0.0, 0.5, 0.25]
    plain = EntropyBonus(EntropyConfig(coefficient=0.5, target=-0.5), 4)
    assert plain.bonus(torch.tensor([-2.0, 3.0])).tolist() == [-1.0, 1.5]
    with pytest.raises(ValueError, match="write a target other than 0"):
        EntropyConfig(normalize=True)


def test_the_bonus_is_constant_without_a_target_and_rises_while_entropy_is_missing() -> None:
    fixed = EntropyBonus(EntropyConfig(coefficient=0.1), 2)
    fixed.adapt(-50.0)
    assert fixed.coefficient == 0.1
    held = EntropyBonus(EntropyConfig(coefficient=0.1, target=-0.5), 2)
    held.adapt(-3.0)  # wanted -1: 2 nat missing
    assert held.coefficient == pytest.approx(0.1 * math.exp(0.01))
    held.adapt(1.0)
    assert held.coefficient == pytest.approx(0.1)
