"""Successive halving (ASHA): at each rung one trial in `reduction` continues.

Ray's own ASHA decides once, when a trial first reaches a rung, by comparison with the trials that came before it:
trials that run in lockstep find the rung empty and pass unjudged. Here a trial is judged again by the newest rung it
has reached at each evaluation until half way (as a ratio) to the next rung, so the order of arrival matters little, and
replaying recorded evaluations gives the same rungs.
"""

import math
from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from msk_ray.config.sections import Count
from msk_ray.experiment.outcomes import Ending, Outcome
from msk_ray.sweep.rules.scheduler import Pruner, SchedulerSpec, Share


class Asha(SchedulerSpec):
    """Stops the worse trials at each rung."""

    grace: Share = 0.25
    """Share of the longest trial's budget within which no trial is stopped. For a search, the longest trial is the
    longest it may suggest; an adaptive horizon counts as its `longest`. A small share stops slow starters."""
    reduction: Annotated[float, Field(ge=1.5, le=16)] = 3.0
    """One trial in this many continues past each rung; rungs are grace × reductionⁿ."""
    min_trials: Count | None = None
    """Number of trials that must have reached a rung before one is stopped; null: `reduction` rounded up."""

    def pruner(self, budget: float) -> Pruner:
        return SuccessiveHalving(self.rungs(budget), self.reduction, self.min_trials)

    def rungs(self, budget: float) -> tuple[float, ...]:
        """grace · reductionⁿ, while below the budget."""
        times = [self.grace * budget]
        while times[-1] * self.reduction < budget:
            times.append(times[-1] * self.reduction)
        return tuple(times)


class SuccessiveHalving:
    """ASHA: at each rung one trial in `reduction` continues (rounded up).

    Trials are compared by their best score so far, as in the final ranking; single evaluations are too noisy.
    """

    def __init__(self, rungs: Sequence[float], reduction: float, min_trials: int | None = None) -> None:
        """
        Args:
            rungs: times at which trials are compared, ascending.
            reduction: one trial in this many continues.
            min_trials: number of trials that must have reached a rung before one is stopped there.
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
                # Only the first result past a rung counts there, so that repeated rows change nothing.
                scores.setdefault(trial, best)
                newest = index
        # Far past its rung, a trial is only judged at the next one: latecomers should not discard most of its work.
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
            f"the best {survivors} continue, from {cutoff:.4g}",
        )
