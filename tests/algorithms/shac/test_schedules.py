"""Schedules by hand."""

import math

import pytest

from msk_ray.algorithms.shac.schedules import adapted_horizon, horizon_at, learning_rate_at
from msk_ray.config import AdaptiveHorizon, HorizonSchedule


def test_horizon_grows_linearly_then_stays() -> None:
    schedule = HorizonSchedule(start=8, end=32, epochs=12)
    assert [horizon_at(schedule, e) for e in (0, 3, 6, 12, 100)] == [8, 14, 20, 32, 32]
    assert horizon_at(16, 50) == 16


def test_learning_rate_is_linear_or_constant() -> None:
    assert learning_rate_at(1.0, 0.5, "linear", 5, 10) == 0.75
    assert learning_rate_at(1.0, 0.5, "constant", 5, 10) == 1.0
    assert learning_rate_at(1e-6, 1e-5, "linear", 5, 10) == 1e-6, "never rises towards a higher final rate"


def test_an_adaptive_horizon_follows_the_cotangents_within_bounds():
    adaptive = AdaptiveHorizon(start=16, shortest=8, longest=32, target=10.0, rate=0.5)
    assert adapted_horizon(adaptive, 16.0, 10.0) == 16.0
    assert adapted_horizon(adaptive, 16.0, 40.0) == pytest.approx(8.0)  # sqrt(1/4)
    assert adapted_horizon(adaptive, 16.0, 4.9) == pytest.approx(16.0 * (10 / 4.9) ** 0.5)
    assert adapted_horizon(adaptive, 16.0, 1e-6) == 32
    assert adapted_horizon(adaptive, 16.0, math.nan) == pytest.approx(16.0 / 2**0.5)
