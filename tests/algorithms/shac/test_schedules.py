"""Schedules by hand."""

import math

import pytest

from msk_ray.algorithms.shac.horizon import RolloutLength
from msk_ray.algorithms.shac.schedules import adapted_horizon, contact_horizon, learning_rate_at
from msk_ray.config import AdaptiveHorizon, ContactHorizon, ExplorationSchedule, HorizonSchedule
from msk_ray.config.schedules import ramp


def test_a_ramp_is_linear_between_its_ends() -> None:
    assert [ramp(8.0, 32.0, epoch, 12) for epoch in (0, 3, 6, 12, 100)] == [8.0, 14.0, 20.0, 32.0, 32.0]
    assert [ramp(1.0, 0.0, epoch, 900, 500) for epoch in (0, 500, 600, 900, 901)] == [1.0, 1.0, 0.75, 0.0, 0.0]


def test_horizon_grows_linearly_then_stays() -> None:
    growing = RolloutLength(HorizonSchedule(start=8, end=32, epochs=12))
    assert [growing.at(e) for e in (0, 3, 6, 12, 100)] == [8, 14, 20, 32, 32]
    assert RolloutLength(16).at(50) == 16


def test_learning_rate_is_linear_or_constant() -> None:
    assert learning_rate_at(1.0, 0.5, "linear", 5, 10) == 0.75
    assert learning_rate_at(1.0, 0.5, "constant", 5, 10) == 1.0
    assert learning_rate_at(1e-6, 1e-5, "linear", 5, 10) == 1e-6, "never rises towards a higher final rate"


def test_an_adaptive_horizon_follows_the_cotangents_within_bounds():
    adaptive = AdaptiveHorizon(start=16, shortest=8, longest=32, target=10.0)
    assert adapted_horizon(adaptive, 16.0, 10.0) == 16.0
    assert adapted_horizon(adaptive, 16.0, 40.0) == pytest.approx(16.0 / 4**0.1)
    assert adapted_horizon(adaptive, 16.0, 4.9) == pytest.approx(16.0 * (10 / 4.9) ** 0.1)
    assert adapted_horizon(adaptive, 16.0, 1e-6) == 32
    assert adapted_horizon(adaptive, 9.0, 1e6) == 8
    for unknown in (math.nan, math.inf, 0.0):
        assert adapted_horizon(adaptive, 16.0, unknown) == pytest.approx(16.0 / 2**0.1)


def test_a_horizon_that_follows_contact_by_hand() -> None:
    config = ContactHorizon(start=16, shortest=8, longest=32, contact=2.0)
    # φ = 0.1 (12/2 − 1) = 1/2, then 1/2 + 0.1 (1/2 − 1) = 0.45; H = 16 (1 − 0.05) = 15.2
    horizon, multiplier = contact_horizon(config, 16.0, 0.0, 12.0)
    assert (horizon, multiplier) == pytest.approx((15.2, 0.5))
    assert contact_horizon(config, 16.0, 0.5, 1.0) == pytest.approx((16.0 * (1.0 - 0.045), 0.45))
    assert contact_horizon(config, 16.0, -1.0, 0.0) == pytest.approx((17.6, -1.0))
    assert contact_horizon(config, 8.5, 1.0, 99.0) == (8.0, 1.0)
    assert contact_horizon(config, 30.0, -1.0, 0.0) == (32.0, -1.0)


def test_exploration_fades_linearly_then_stays() -> None:
    schedule = ExplorationSchedule(start=2.0, end=0.0, epochs=4)
    assert [schedule.at(epoch) for epoch in (0, 1, 4, 9)] == [2.0, 1.5, 0.0, 0.0]
