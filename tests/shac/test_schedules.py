"""Schedules by hand."""

from msk_ray.config import HorizonSchedule
from msk_ray.shac.schedules import horizon_at, learning_rate_at


def test_horizon_grows_linearly_then_stays() -> None:
    schedule = HorizonSchedule(start=8, end=32, epochs=12)
    assert [horizon_at(schedule, e) for e in (0, 3, 6, 12, 100)] == [8, 14, 20, 32, 32]
    assert horizon_at(16, 50) == 16


def test_learning_rate_is_linear_or_constant() -> None:
    assert learning_rate_at(1.0, 0.5, "linear", 5, 10) == 0.75
    assert learning_rate_at(1.0, 0.5, "constant", 5, 10) == 1.0
    assert learning_rate_at(1e-6, 1e-5, "linear", 5, 10) == 1e-6, "never rises towards a higher final rate"
