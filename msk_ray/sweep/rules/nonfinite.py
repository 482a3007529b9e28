"""Ends a trial whose results are not finite."""

import math
from collections.abc import Mapping

from msk_ray.experiment.outcomes import Outcome
from msk_ray.metrics import SCORE
from msk_ray.sweep.rules.stop_rule import History, StopRule


class NonFinite(StopRule):
    """Ends a trial whose score, loss or gradient is NaN or infinite."""

    outcome = Outcome.NONFINITE
    by_score = False
    before_the_end = True

    def why(self, history: History) -> str | None:
        bad = nonfinite_metric(history.row)
        return None if bad is None else f"{bad} is {history.row[bad]} at epoch {history.epoch}"


def nonfinite_metric(row: Mapping[str, float]) -> str | None:
    """The first non-finite metric among score, losses and gradient norms.

    Other metrics may be undefined, such as the episode return in an epoch without an end of an episode.
    """
    for key, value in row.items():
        if (key == SCORE or key.endswith(("loss", "grad_norm"))) and not math.isfinite(value):
            return key
    return None
