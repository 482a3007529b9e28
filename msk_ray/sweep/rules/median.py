"""The median rule: stops a trial that does worse than most others."""

import math
import statistics
from bisect import bisect_right
from itertools import accumulate

from msk_ray.config.sections import Count
from msk_ray.experiment.outcomes import Ending, Outcome
from msk_ray.sweep.rules.scheduler import Pruner, SchedulerSpec, Share


class Median(SchedulerSpec):
    """Stops trials below the median."""

    grace: Share = 0.25
    """Share of the longest trial's budget within which no trial is stopped."""
    min_trials: Count = 3
    """Number of other trials that must have reached the same time before one is stopped."""

    def pruner(self, budget: float) -> Pruner:
        return MedianStopping(self.grace * budget, self.min_trials)


class MedianStopping:
    """Stops a trial whose best score is below the median of the other trials' mean scores up to the same time."""

    def __init__(self, grace: float, min_trials: int) -> None:
        """
        Args:
            grace: time before which no trial is stopped.
            min_trials: number of other trials that must have reached the same time.
        """
        self._grace = grace
        self._min_trials = min_trials
        self._curves: dict[str, _Curve] = {}

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        if not math.isfinite(score):
            return None
        own = self._curves.setdefault(trial, _Curve())
        own.add(time, score)
        # In lockstep no other trial has reached this one's time; then compare at the time that enough have reached.
        for moment in reversed(own.times):
            if not self._grace <= moment <= time:
                continue
            means = [curve.mean(moment) for curve in self._curves.values() if curve is not own and curve.spans(moment)]
            if len(means) >= self._min_trials:
                return _judge(own.best(moment), moment, means)
        return None

    def forget(self, trial: str) -> None:
        self._curves.pop(trial, None)


class _Curve:
    """A trial's scores over time, with their sums: every report of another trial asks for a mean."""

    def __init__(self) -> None:
        self.times: list[float] = []
        """Ascending."""
        self._scores: list[float] = []
        self._sums: list[float] = []

    def add(self, time: float, score: float) -> None:
        """Add a score, or replace the one of the same time."""
        scores = dict(zip(self.times, self._scores, strict=True)) | {time: score}
        self.times = sorted(scores)
        self._scores = [scores[moment] for moment in self.times]
        self._sums = list(accumulate(self._scores))

    def spans(self, moment: float) -> bool:
        """Whether a time lies between the first and the last."""
        return self.times[0] <= moment <= self.times[-1]

    def mean(self, moment: float) -> float:
        """Mean of the scores up to a time that it spans."""
        count = bisect_right(self.times, moment)
        return self._sums[count - 1] / count

    def best(self, moment: float) -> float:
        """The highest score up to a time that it spans."""
        return max(self._scores[: bisect_right(self.times, moment)])


def _judge(best: float, moment: float, means: list[float]) -> Ending | None:
    median = statistics.median(means)
    if best >= median:
        return None
    return Ending(
        Outcome.STOPPED_MEDIAN,
        f"best score {best:.4g} up to {moment:.6g} is below the median {median:.4g} of {len(means)} other trials",
    )
