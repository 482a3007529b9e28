"""Rules by which trials are stopped because others do better. Pure: fed with evaluations, they answer with a reason.

Ray's own ASHA decides once, when a trial first reaches a rung, against those that came before it: trials that run in
lockstep find the rung empty and pass unjudged. Here a trial is judged again by the newest rung it has reached at each
report until half way (as a ratio) to the next rung, so the order of arrival matters little, and replaying recorded
evaluations gives the same rungs.
"""

import math
import statistics
from collections.abc import Sequence
from typing import Protocol

from msk_ray.experiment.outcomes import Ending, Outcome
from msk_ray.sweep.space import SchedulerSpec


class Pruner(Protocol):
    """A rule that compares trials."""

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        """Take in one evaluation; answer why the trial should end now, or None."""

    def forget(self, trial: str) -> None:
        """Drop what a trial has reported: it starts anew."""


class NeverPrune:
    """Lets every trial run."""

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        return None

    def forget(self, trial: str) -> None:
        return None


class SuccessiveHalving:
    """ASHA: at each rung one in `reduction` trials goes on (rounded up).

    Trials are compared by their best score so far, as in the final ranking; single evaluations scatter too much.
    """

    def __init__(self, rungs: Sequence[float], reduction: float, min_trials: int | None = None) -> None:
        """
        Args:
            rungs: times at which trials are compared, ascending.
            reduction: one in this many goes on.
            min_trials: trials that must have reached a rung before one is stopped there.
        """
        self._rungs = tuple(rungs)
        self._scores: list[dict[str, float]] = [{} for _ in rungs]
        self._best: dict[str, float] = {}
        self._reduction = reduction
        self._min_trials = math.ceil(reduction) if min_trials is None else min_trials

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        if not math.isfinite(score):
            return None
        best = self._best[trial] = max(score, self._best.get(trial, score))
        newest: int | None = None
        for index, (rung, scores) in enumerate(zip(self._rungs, self._scores, strict=True)):
            if time >= rung:
                # The first report past a rung counts there, whatever follows: repeated rows change nothing.
                scores.setdefault(trial, best)
                newest = index
        # Far past its rung, a trial is left to the next one: latecomers should not undo most of its work.
        if newest is None or time >= self._rungs[newest] * math.sqrt(self._reduction):
            return None
        return self._judge(trial, newest)

    def forget(self, trial: str) -> None:
        self._best.pop(trial, None)
        for scores in self._scores:
            scores.pop(trial, None)

    def _judge(self, trial: str, index: int) -> Ending | None:
        scores = self._scores[index]
        if len(scores) < max(self._min_trials, 2):
            return None
        survivors = math.ceil(len(scores) / self._reduction)
        better = sum(score > scores[trial] for score in scores.values())
        if better < survivors:
            return None
        cutoff = sorted(scores.values(), reverse=True)[survivors - 1]
        return Ending(
            Outcome.STOPPED_ASHA,
            f"best score {scores[trial]:.4g} is number {better + 1} of {len(scores)} at rung {self._rungs[index]:.6g}; "
            f"{survivors} go on, from {cutoff:.4g}",
        )


class MedianStopping:
    """Stops a trial whose best score lies below the median of the other trials' mean scores up to the same time."""

    def __init__(self, grace: float, min_trials: int = 3) -> None:
        """
        Args:
            grace: time before which nothing is compared.
            min_trials: other trials that must have come as far.
        """
        self._grace = grace
        self._min_trials = min_trials
        self._history: dict[str, dict[float, float]] = {}

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        if not math.isfinite(score):
            return None
        own = self._history.setdefault(trial, {})
        own[time] = score
        # In lockstep nobody has come as far as the one that reports; then compare where enough others have been.
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


def make_pruner(spec: SchedulerSpec, budget: float) -> Pruner:
    """The rule a space asks for.

    Args:
        spec: the space's scheduler section.
        budget: what the longest trial takes, in the unit of `spec.time_attr`.
    """
    grace = spec.grace * budget
    if spec.kind == "asha":
        return SuccessiveHalving(rungs(grace, budget, spec.reduction), spec.reduction, spec.min_trials)
    if spec.kind == "median":
        return MedianStopping(grace, spec.min_trials or 3)
    return NeverPrune()


def rungs(grace: float, budget: float, reduction: float) -> tuple[float, ...]:
    """grace · reductionⁿ, as long as it lies below the budget."""
    times = [grace]
    while times[-1] * reduction < budget:
        times.append(times[-1] * reduction)
    return tuple(times)
