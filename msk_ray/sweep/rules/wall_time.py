"""Ends a trial that has used up its time."""

from typing import Annotated

from pydantic import Field

from msk_ray.experiment.outcomes import Outcome
from msk_ray.sweep.rules.stop_rule import History, StopRule


class WallTime(StopRule):
    """Ends a trial after a given training time."""

    outcome = Outcome.WALL_TIME
    by_score = False
    shorthand = "seconds"

    seconds: Annotated[float, Field(gt=0.0)]
    """Largest training time of a trial, summed over its attempts [s]."""

    def why(self, history: History) -> str | None:
        if history.elapsed_s < self.seconds:
            return None
        return f"{history.elapsed_s:.0f} s of {self.seconds:g} s used at epoch {history.epoch}"
