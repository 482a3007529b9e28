"""Intervals and effects by hand."""

import math

import numpy as np
import pytest

from msk_ray.report.charts import POINTS, thin_peaks
from msk_ray.report.statistics import TrialScore, difference_interval, effects, levels_of, mean_interval, variance_share


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


def test_share_of_variance_by_hand() -> None:
    # Means 1 and 4, grand mean 2.5: between 4 · 2.25 = 9, within 4 · 1/4 = 1 over 2 degrees of freedom, MS = 0.5.
    # ω² = (9 − 0.5) / (10 + 0.5).
    assert variance_share([[0.5, 1.5], [3.5, 4.5]]) == pytest.approx(8.5 / 10.5)
    assert variance_share([[0.0, 1.0], [0.0, 1.0]]) == pytest.approx(-0.5 / 1.5), "none, less chance"
    assert variance_share([[1.0], [2.0]]) is None
    assert variance_share([[1.0, 1.0], [1.0]]) == 0.0


def test_levels_of_numbers_and_names() -> None:
    rows = [("big", 10, 1.0), ("small", 2, 2.0), ("big", 10, 3.0)]
    assert levels_of(rows) == {"small": [2.0], "big": [1.0, 3.0]}
    assert list(levels_of([("b", "b", 1.0), ("a", "a", 2.0)])) == ["b", "a"], "names stay in order"
    drawn = [(f"{n}", float(n), float(n)) for n in range(12)]
    quarters = levels_of(drawn)
    assert [len(scores) for scores in quarters.values()] == [3, 3, 3, 3]
    assert next(iter(quarters.values())) == [0.0, 1.0, 2.0]
    close = levels_of([("", 1000 + n, float(n)) for n in range(12)])
    assert list(close) == ["1000 … 1003", "1003 … 1006", "1006 … 1008", "1008 … 1011"], "digits that tell them apart"
    assert [len(items) for items in close.values()] == [3, 3, 3, 3]


def test_the_parameter_that_matters_comes_first() -> None:
    rng = np.random.default_rng(0)
    trials = []
    for seed in range(4):
        for rate in (0.1, 0.01):
            for horizon in (8, 16):
                score = (100.0 if rate == 0.1 else 0.0) + rng.normal()
                trials.append(TrialScore({"lr": f"{rate}", "h": f"{horizon}"}, {"lr": rate, "h": horizon}, seed, score))
    ranked = effects(trials)
    assert ranked[0].factor == "lr"
    assert {effect.factor for effect in ranked} == {"lr", "h", "seed"}
    assert ranked[0].share == pytest.approx(1.0, abs=0.01)
    assert ranked[0].spread == pytest.approx(100.0, abs=2.0)
    assert max(effect.share or 0.0 for effect in ranked[1:]) < 0.1
    assert effects([TrialScore({"lr": "1"}, {"lr": 1}, 0, 5.0)]) == []


def scored(level: float, *scores: float | None) -> list[TrialScore]:
    return [TrialScore({"lr": f"{level}"}, {"lr": level}, 0, score) for score in scores]


def test_too_few_scores_give_no_share_and_say_where() -> None:
    enough = [*scored(0.1, 0.5, 1.5), *scored(0.2, 3.5, 4.5)]
    (effect,) = effects(enough)
    assert (effect.share, effect.too_few) == (pytest.approx(8.5 / 10.5), "")
    # One more level nobody was trained at, or once: what lies between the others is not the parameter's effect.
    (effect,) = effects([*enough, *scored(0.3, None, None)])
    assert (effect.share, effect.too_few, effect.spread) == (None, "0.3 has none", 3.0)
    (effect,) = effects([*scored(0.1, 1.0, 2.0), *scored(0.2, 3.0, None)])
    assert (effect.share, effect.too_few, effect.spread) == (None, "0.2 has 1", 1.5)
    (effect,) = effects([*scored(0.1, 1.0, 2.0), *scored(0.2, None), *scored(0.3, None)])
    assert (effect.share, effect.too_few, effect.spread) == (None, "0.2 has none, and 1 more", None)


def test_thinning_keeps_every_peak() -> None:
    y = np.zeros(10 * POINTS)
    peaks = np.random.default_rng(1).choice(len(y), 20, replace=False)
    y[peaks] = 1.0 + np.arange(20)
    y[np.setdiff1d(np.arange(0, len(y), 7), peaks)] = np.nan
    x, thinned = thin_peaks(np.arange(len(y), dtype=float), y)
    assert len(x) <= POINTS
    assert thinned.max() == 20.0
    assert np.all(y[x.astype(int)] == thinned), "each at its own place"
    blocks = np.unique(peaks // 10)
    assert (thinned > 0).sum() == len(blocks)
