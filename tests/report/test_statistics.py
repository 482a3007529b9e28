"""Intervals by hand."""

import math

import numpy as np
import pytest

from msk_ray.report.statistics import difference_interval, mean_interval


def test_interval_of_a_mean() -> None:
    assert mean_interval([3.0]) is None
    assert mean_interval([2.0, 2.0, 2.0]) is not None
    same = mean_interval([2.0, 2.0, 2.0])
    assert same is not None
    assert (same.low, same.high) == (2.0, 2.0)
    # Of two scores the mean is drawn as 0, 1/2 or 1 with probability 1/4, 1/2, 1/4: the middle 95 % reach both ends.
    two = mean_interval([0.0, 1.0])
    assert two is not None
    assert (two.low, two.high) == (0.0, 1.0)
    # Of many, it is that of the normal distribution: ± 1.96 σ / √n.
    many = np.random.default_rng(7).normal(10.0, 2.0, 400)
    interval = mean_interval(list(many))
    assert interval is not None
    half = 1.96 * many.std() / math.sqrt(400)
    assert interval.low == pytest.approx(many.mean() - half, abs=0.02)
    assert interval.high == pytest.approx(many.mean() + half, abs=0.02)


def test_interval_of_a_difference() -> None:
    assert difference_interval([1.0, 2.0], [1.0]) is None
    apart = difference_interval([10.0, 11.0, 12.0], [0.0, 1.0, 2.0])
    assert apart is not None
    assert (apart.low, apart.high) == pytest.approx((8.33, 11.67), abs=0.35)
    assert apart.excludes(0.0)
    assert not apart.excludes(10.0)
    # Both are drawn independently: the interval of equal samples is not a point.
    equal = difference_interval([0.0, 1.0], [0.0, 1.0])
    assert equal is not None
    assert (equal.low, equal.high) == (-1.0, 1.0)
