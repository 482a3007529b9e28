"""Which parameters of an experiment matter: effects of each on the best score of its trials."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from msk_ray.report.reading import Reading

T = TypeVar("T")

LEAST = 2
"""A share of the variance needs this many scores at each level."""
BINS = 4
"""Groups into which numbers with many values are sorted."""


@dataclass(frozen=True)
class TrialScore:
    """A trial's parameters and its best score; None before its first evaluation."""

    changed: Mapping[str, str]
    """Its parameters as text."""
    values: Mapping[str, Any]
    """The same as data."""
    seed: int
    score: float | None
    cut: bool = False
    """It did not run to its end: the score might have risen further."""
    place: int = 0
    """Its position in the caller's list."""


@dataclass(frozen=True)
class Effect:
    """How the score depends on one parameter, averaged over the others."""

    factor: str
    trials: dict[str, list[TrialScore]]
    """Trials at each level, in order of the level, including those without a score."""

    @property
    def levels(self) -> dict[str, list[float]]:
        """Scores at each level, without levels that have none."""
        scores_of = {level: [t.score for t in trials if t.score is not None] for level, trials in self.trials.items()}
        return {level: scores for level, scores in scores_of.items() if scores}

    def with_score(self, level: str) -> list[TrialScore]:
        """Trials at a level that have a score."""
        return [trial for trial in self.trials[level] if trial.score is not None]

    @property
    def too_few(self) -> str:
        """Which level has fewer than LEAST scores, in words; empty if none has."""
        levels = self.levels
        counts = {level: len(levels.get(level, ())) for level in self.trials}
        short = {level: count for level, count in counts.items() if count < LEAST}
        if not short:
            return ""
        level, count = min(short.items(), key=lambda item: item[1])
        more = f", and {len(short) - 1} more" if len(short) > 1 else ""
        return f"{level} has {count or 'none'}{more}"

    @cached_property
    def share(self) -> float | None:
        """Share of the variance of the scores, ω²; None if any level has too few scores."""
        return None if self.too_few else variance_share(list(self.levels.values()))

    @property
    def spread(self) -> float | None:
        """Difference between the best and the worst level's mean score; None unless two levels have one."""
        means = [sum(scores) / len(scores) for scores in self.levels.values()]
        return max(means) - min(means) if len(means) > 1 else None


def ranked_effects(reading: Reading, places: Mapping[Path, int]) -> list[Effect]:
    """Effects of the experiment's parameters on the best score, the largest first.

    Args:
        places: trials' positions in the page's list.
    """
    return effects(
        [
            TrialScore(t.trial.changed, t.trial.values, t.trial.seed, t.score, t.cut, places[t.folder])
            for t in reading.trials
        ]
    )


def effects(trials: Sequence[TrialScore]) -> list[Effect]:
    """Parameters ranked by the share of the scores' variance that they explain, the largest first; then those with too
    few scores, by their spread.

    Args:
        trials: all planned trials, including those without a score: a level must not vanish because none of its
            trials has one.

    Returns:
        An effect for each parameter with at least two levels, and one called `seed` for comparison if there are
        several seeds.
    """
    factors = list(dict.fromkeys(key for trial in trials for key in trial.changed))
    all_effects = []
    for factor in factors:
        rows = [(trial.changed[factor], trial.values.get(factor), trial) for trial in trials if factor in trial.changed]
        all_effects.append(Effect(factor, levels_of(rows)))
    by_seed: dict[str, list[TrialScore]] = {}
    for trial in sorted(trials, key=lambda trial: trial.seed):
        by_seed.setdefault(str(trial.seed), []).append(trial)
    all_effects.append(Effect("seed", by_seed))
    kept = [effect for effect in all_effects if len(effect.trials) > 1]
    return sorted(kept, key=lambda e: (math.inf if e.share is None else -e.share, -(e.spread or 0.0)))


def levels_of(rows: Sequence[tuple[str, Any, T]]) -> dict[str, list[T]]:
    """Items by level. Numbers with many different values, such as random ones, are sorted into quartiles.

    Args:
        rows: (level as text, level as data, item).
    """
    numbers = [value for _, value, _ in rows if isinstance(value, int | float) and not isinstance(value, bool)]
    levels: dict[str, list[T]] = {}
    if len(numbers) == len(rows) and len(set(numbers)) > 2 * BINS:
        edges = np.quantile(numbers, np.linspace(0.0, 1.0, BINS + 1))
        bins = np.clip(np.searchsorted(edges, numbers, side="right") - 1, 0, BINS - 1)
        filled = sorted(set(bins.tolist()))
        labels = _bin_labels([(float(edges[place]), float(edges[place + 1])) for place in filled])
        for label, place in zip(labels, filled, strict=True):
            levels[label] = [item for (_, _, item), own in zip(rows, bins, strict=True) if own == place]
        return levels
    numeric = len(numbers) == len(rows)
    for label, _, item in sorted(rows, key=lambda row: row[1]) if numeric else rows:
        levels.setdefault(label, []).append(item)
    return levels


def _bin_labels(bins: Sequence[tuple[float, float]]) -> list[str]:
    """`low … high` of each, with three digits, or as many as make them all different."""
    for digits in range(3, 18):
        labels = [f"{low:.{digits}g} … {high:.{digits}g}" for low, high in bins]
        if len(set(labels)) == len(labels):
            return labels
    raise AssertionError("different numbers differ within 17 digits")


def variance_share(groups: Sequence[Sequence[float]]) -> float | None:
    """ω² = (SS_between − (k − 1) MS_within) / (SS_total + MS_within) of k groups, n values: the share of the variance
    between groups, minus what chance alone would produce; below 0 means none.

    Hays 1963, "Statistics for Psychologists", chapter 12. None if no group has two values; 0 if all are equal.
    """
    values = np.concatenate([np.asarray(group, dtype=float) for group in groups])
    k, n = len(groups), len(values)
    if n <= k:
        return None
    mean = values.mean()
    between = sum(len(group) * (float(np.mean(group)) - mean) ** 2 for group in groups)
    total = float(((values - mean) ** 2).sum())
    if total == 0.0:
        return 0.0
    within = (total - between) / (n - k)
    return float((between - (k - 1) * within) / (total + within))
