"""Rules by which a trial ends itself, from its own history alone. Pure: no Ray, no files, no clock."""

import math
from collections.abc import Mapping, Sequence

from msk_ray.experiment.metrics import SCORE, Evaluation
from msk_ray.experiment.outcomes import Ending, Outcome
from msk_ray.sweep.space import PlateauSpec, StopSpec


def ending_of(
    stop: StopSpec, row: Mapping[str, float], evaluations: Sequence[Evaluation], epochs: int, elapsed_s: float
) -> Ending | None:
    """Whether a trial ends after the epoch that gave `row`, and how; None to go on.

    Args:
        stop: the space's rules.
        row: metrics of the epoch just done.
        evaluations: all evaluations so far, the newest last.
        epochs: the trial's full length.
        elapsed_s: work so far over all attempts [s].
    """
    if stop.nonfinite and (bad := nonfinite_metric(row)) is not None:
        return Ending(Outcome.NONFINITE, f"{bad} is {row[bad]} at epoch {int(row['epoch'])}")
    if stop.target is not None and evaluations and evaluations[-1].score >= stop.target:
        newest = evaluations[-1]
        return Ending(
            Outcome.STOPPED_TARGET, f"score {newest.score:.4g} at epoch {newest.epoch}, asked {stop.target:g}"
        )
    if row["epoch"] >= epochs:
        return Ending(Outcome.FINISHED, f"all {epochs} epochs done")
    if stop.wall_time_s is not None and elapsed_s >= stop.wall_time_s:
        return Ending(
            Outcome.WALL_TIME, f"{elapsed_s:.0f} s of {stop.wall_time_s:g} s used at epoch {int(row['epoch'])}"
        )
    if stop.plateau is not None and SCORE in row:
        return plateau(stop.plateau, evaluations, epochs)
    return None


def nonfinite_metric(row: Mapping[str, float]) -> str | None:
    """The first metric that must be a number and is none: the score, a loss, or a gradient norm.

    Others, such as the return of episodes in an epoch where none ended, may well be undefined.
    """
    for key, value in row.items():
        if (key == SCORE or key.endswith(("loss", "grad_norm"))) and not math.isfinite(value):
            return key
    return None


def plateau(spec: PlateauSpec, evaluations: Sequence[Evaluation], epochs: int) -> Ending | None:
    """Stop when the last `patience` evaluations brought no rise of more than `min_delta` over the best before them."""
    if len(evaluations) <= spec.patience or evaluations[-1].epoch < spec.grace * epochs:
        return None
    before, recent = evaluations[: -spec.patience], evaluations[-spec.patience :]
    best_before = max(evaluation.score for evaluation in before)
    best_recent = max(evaluation.score for evaluation in recent)
    if best_recent > best_before + spec.min_delta:
        return None
    return Ending(
        Outcome.STOPPED_PLATEAU,
        f"no rise over {best_before:.4g} in {spec.patience} evaluations, since epoch {before[-1].epoch}",
    )
