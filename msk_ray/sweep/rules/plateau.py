"""Ends a trial whose best score no longer rises."""

from typing import Annotated

from pydantic import Field

from msk_ray.config.sections import Count
from msk_ray.experiment.outcomes import Outcome
from msk_ray.metrics import SCORE
from msk_ray.sweep.rules.stop_rule import History, StopRule


class Plateau(StopRule):
    """Ends a trial when its last `patience` evaluations did not improve on the best one before."""

    outcome = Outcome.STOPPED_PLATEAU

    patience: Count
    """Number of evaluations without an improvement."""
    min_delta: Annotated[float, Field(ge=0.0)] = 0.0
    """Smallest improvement that counts [score]."""
    grace: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.2
    """Share of the trial's epochs before which it is not stopped."""

    def why(self, history: History) -> str | None:
        evaluations = history.evaluations
        if SCORE not in history.row or len(evaluations) <= self.patience:
            return None
        if evaluations[-1].epoch < self.grace * history.epochs:
            return None
        before, recent = evaluations[: -self.patience], evaluations[-self.patience :]
        best_before = max(evaluation.score for evaluation in before)
        best_recent = max(evaluation.score for evaluation in recent)
        if best_recent > best_before + self.min_delta:
            return None
        return f"no improvement over {best_before:.4g} in {self.patience} evaluations, since epoch {before[-1].epoch}"
