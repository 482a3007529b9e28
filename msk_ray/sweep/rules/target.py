"""Ends a trial that has reached its target score."""

from msk_ray.experiment.outcomes import Outcome
from msk_ray.sweep.rules.stop_rule import History, StopRule


class Target(StopRule):
    """Ends a trial whose newest evaluation reaches a score."""

    outcome = Outcome.STOPPED_TARGET
    before_the_end = True
    shorthand = "score"

    score: float
    """Target score."""

    def why(self, history: History) -> str | None:
        if not history.evaluations or history.evaluations[-1].score < self.score:
            return None
        newest = history.evaluations[-1]
        return f"score {newest.score:.4g} at epoch {newest.epoch}, target {self.score:g}"
