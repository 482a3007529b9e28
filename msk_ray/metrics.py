"""Registry of the metrics that a trial logs: description, unit, reduction over processes, and how they are drawn.

Metrics are for people; trials are steered by typed values. An unlisted name, for example of a user's algorithm or
environment, serves as its own description, and is averaged.
"""

import math
from collections.abc import Sequence
from fnmatch import fnmatch
from typing import Literal, NamedTuple


class Metric(NamedTuple):
    """One logged metric."""

    name: str
    """Its name; `*` stands for any part."""
    meaning: str
    """Description with unit."""
    over: Literal["mean", "smallest", "largest"] = "mean"
    """How values of equal parts of the worlds combine."""
    logarithmic: bool = False
    """Whether its axis is logarithmic."""
    health: bool = False
    """Whether the report draws it among the gradient diagnostics."""


SCORE = "eval/score"
"""The score, by which trials are ranked; higher is better."""
BEST_SCORE = "eval/best_score"
REWARD = "train/reward"
EPISODE_RETURN = "train/episode_return"
STEPS_PER_SECOND = "env_steps_per_s"

METRICS = (
    Metric(SCORE, "mean return of the evaluation's episodes under the reference reward"),
    Metric(BEST_SCORE, "best score so far"),
    Metric(STEPS_PER_SECOND, "env steps a second of training"),
    Metric(REWARD, "mean reward of an env step"),
    Metric(EPISODE_RETURN, "mean return of the episodes that ended in an epoch"),
    Metric("grad/actor_norm", "norm of the policy's gradient", logarithmic=True, health=True),
    Metric("grad/state_p90", "state cotangent, 90th percentile [rewards]", logarithmic=True, health=True),
    Metric("grad/clipped_share", "share of cotangents clipped", health=True),
    Metric("grad/nonfinite_share", "share of worlds without a gradient", health=True),
    Metric("grad/approximated_share", "share of substeps with an approximate gradient", health=True),
    Metric("physics/solver_limit_share", "share of worlds at the solver's limit", health=True),
    Metric("physics/solver_unconverged_share", "share of worlds that the solver left unconverged", health=True),
    Metric("physics/solver_residual_max", "largest share of a world's forces left unbalanced", over="largest"),
    Metric("physics/contacts_share", "largest share of a world's contact buffer in use", over="largest"),
    Metric("physics/rows_share", "largest share of a world's constraint rows in use", over="largest"),
    Metric("physics/fd_solver_limit_share", "share of perturbed copies at the solver's limit", over="largest"),
    Metric("train/diverged", "worlds diverged an epoch", health=True),
    Metric("randomize/*_min", "smallest number drawn", over="smallest"),
    Metric("randomize/*_max", "largest number drawn", over="largest"),
)
HEALTH = tuple(metric for metric in METRICS if metric.health)
"""Gradient and physics diagnostics that the report draws, in this order."""

_DIAGNOSTICS = {metric.name.partition("/")[2]: metric.name for metric in METRICS if "/" in metric.name}


def metric(name: str) -> Metric:
    """The entry of a metric."""
    return next((known for known in METRICS if fnmatch(name, known.name)), Metric(name, name))


def diagnostic(name: str) -> str:
    """Metric name of a simulation diagnostic: `grad/...` if that is listed, otherwise `physics/...`."""
    return _DIAGNOSTICS.get(name, f"physics/{name}")


def of_all_processes(name: str, values: Sequence[float]) -> float:
    """Combine a metric's values of equal parts of the worlds; NaN if one of them is."""
    if any(math.isnan(value) for value in values):
        return math.nan
    match metric(name).over:
        case "smallest":
            return min(values)
        case "largest":
            return max(values)
        case _:
            return sum(values) / len(values)
