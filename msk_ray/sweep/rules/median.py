"""The median rule: stops a trial that does worse than most others."""

import math
import statistics

from msk_ray.config.sections import Count
from msk_ray.experiment.outcomes import Ending, Outcome
from msk_ray.sweep.rules.scheduler import Pruner, SchedulerSpec, Share


class Median(SchedulerSpec):
    """Stops trials below the median."""

    grace: Share = 0.25
    """Share of the longest trial's budget within which no trial is stopped."""
    min_trials: Count | None = None
    """Number of other trials that must have reached the same time before one is stopped; null: 3."""

    def pruner(self, budget: float) -> Pruner:
        return MedianStopping(self.grace * budget, self.min_trials or 3)


class MedianStopping:
    """Stops a trial whose best score is below the median of the other trials' mean scores up to the same time."""

    def __init__(self, grace: float, min_trials: int = 3) -> None:
        """
        Args:
            grace: time before which no trial is stopped.
            min_trials: number of other trials that must have reached the same time.
        """
        self._grace = grace
        self._min_trials = min_trials
        self._history: dict[str, dict[float, float]] = {}

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        if not math.isfinite(score):
            return None
        own = self._history.setdefault(trial, {})
        own[time] = score
        # In lockstep no other trial has reached this one's time; then compare at the time that enough have reached.
        for moment in sorted((t for t in own if self._grace <= t <= time), reverse=True):
            means = [
                statistics.fmean(s for t, s in history.items() if t <= moment)
                for other, history in self._history.items()
                if other != trial and max(history) >= moment >= min(history)
            ]
            if len(means) >= self._min_trials:
                return self._judge(own, moment, means)
        return None

    def forget(self, trial: str) -> None:
        self._history.pop(trial, None)

    def _judge(self, own: dict[float, float], moment: float, means: list[float]) -> Ending | None:
        best = max(s for t, s in own.items() if t <= moment)
        median = statistics.median(means)
        if best >= median:
            return None
        return Ending(
            Outcome.STOPPED_MEDIAN,
            f"best score {best:.4g} up to {moment:.6g} is below the median {median:.4g} of {len(means)} other trials",
        )
