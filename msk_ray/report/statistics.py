"""Confidence intervals of the mean scores of few trials. Pure functions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

DRAWS = 10_000
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """A confidence interval."""

    low: float
    high: float

    def excludes(self, value: float) -> bool:
        return not self.low <= value <= self.high


def mean_interval(scores: Sequence[float]) -> Interval | None:
    """Percentile bootstrap of the mean: the scores are resampled with replacement DRAWS times; the interval holds the
    middle 95 % of the means. None for fewer than two scores.

    Efron and Tibshirani 1993, "An Introduction to the Bootstrap", chapter 13; over runs with different seeds as in
    Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice", arXiv:2108.13264. With
    fewer than about ten seeds such an interval is too narrow.
    """
    return _interval(_means(scores, 0)) if len(scores) > 1 else None


def difference_interval(scores: Sequence[float], baseline: Sequence[float]) -> Interval | None:
    """Percentile bootstrap of mean(scores) − mean(baseline), both resampled independently; see `mean_interval`.

    None unless both have at least two scores.
    """
    if min(len(scores), len(baseline)) < 2:
        return None
    return _interval(_means(scores, 0) - _means(baseline, 1))


def _means(scores: Sequence[float], seed: int) -> np.ndarray:
    values = np.asarray(scores, dtype=float)
    picks = np.random.default_rng(seed).integers(0, len(values), (DRAWS, len(values)))
    return values[picks].mean(1)


def _interval(statistic: np.ndarray) -> Interval:
    tail = 100.0 * (1.0 - CONFIDENCE) / 2.0
    low, high = np.percentile(statistic, (tail, 100.0 - tail))
    return Interval(float(low), float(high))
