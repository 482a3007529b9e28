"""Gait measures over episodes."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from msk_ray.envs.legs.gait.body import CURVES, SIDES, Array, Episode
from msk_ray.envs.legs.gait.cycles import (
    Stride,
    cadence,
    extremum,
    mean_curve,
    on_ground,
    over_cycle,
    step_lengths,
    strides,
    symmetry_index,
)
from msk_ray.envs.legs.gait.ranges import LANDMARKS, MEASURES

SETTLING = 1.0
"""Start of an episode that is left out [s], so that the settled gait is measured."""


def measure(episodes: Sequence[Episode], fell: Sequence[bool]) -> dict[str, Any]:
    """Measures over all episodes, JSON types only; null for what no episode contained.

    Args:
        episodes: time series, each up to its end.
        fell: whether each ended in a fall.

    Returns:
        `measures`: value, human range, unit, source and whether the value is in the range, for speed, cadence, step
        length, duty factor and symmetry. `landmarks`: the same for points of the curves. `curves`: mean and standard
        deviation over strides at each percent of the cycle, by side. `costs`, `falls`, `strides`, `episodes`.
    """
    values: dict[str, list[float]] = {"speed": [], "cadence": []}
    sided: dict[str, dict[str, list[float]]] = {
        name: {side: [] for side in SIDES} for name in ("step_length", "duty_factor")
    }
    curves: dict[str, dict[str, list[Array]]] = {name: {side: [] for side in SIDES} for name in CURVES}
    costs: dict[str, list[float]] = {"mean_squared_activation": [], "activation_per_metre": [], "work_per_metre": []}
    count = 0
    for episode in episodes:
        start = round(SETTLING / episode.timestep)
        if len(episode.forward) - start < 2:
            continue
        seconds = (len(episode.forward) - 1 - start) * episode.timestep
        distance = float(episode.forward[-1] - episode.forward[start])
        values["speed"].append(distance / seconds)
        _add_costs(costs, episode, start, distance)
        contact = {
            side: on_ground(episode.curves["vertical_force"][side][start:], 1.0, least=_least(episode.timestep))
            for side in SIDES
        }
        steps = cadence(contact["r"], contact["l"], episode.timestep)
        if steps is not None:
            values["cadence"].append(steps)
        for side, other in zip(SIDES, reversed(SIDES), strict=True):
            own, opposite = episode.feet[side][start:], episode.feet[other][start:]
            sided["step_length"][side] += step_lengths(contact[side], own, opposite).tolist()
            found: list[Stride] = strides(contact[side])
            count += len(found)
            sided["duty_factor"][side] += [stride.duty for stride in found]
            for name in CURVES:
                curves[name][side] += [over_cycle(episode.curves[name][side][start:], stride) for stride in found]
    measures = {name: _mean(found) for name, found in values.items()}
    for name, by_side in sided.items():
        measures[name] = _mean(by_side["r"] + by_side["l"])
        right, left = _mean(by_side["r"]), _mean(by_side["l"])
        both = right is not None and left is not None
        measures[f"symmetry_{name}"] = symmetry_index(right or 0.0, left or 0.0) if both else None
    return {
        "measures": {name: _beside(measures[name], limits) for name, limits in MEASURES.items()},
        "by_side": {name: {side: _mean(found) for side, found in by.items()} for name, by in sided.items()},
        "landmarks": _landmarks(curves),
        "curves": _mean_curves(curves),
        "curve_asymmetry": _asymmetry(curves),
        "costs": {name: _mean(found) for name, found in costs.items()},
        "falls": float(np.mean(fell)) if len(fell) else None,
        "strides": count,
        "episodes": len(episodes),
    }


def _least(timestep: float) -> int:
    """Samples in 60 ms: no step or swing is shorter."""
    return max(1, round(0.06 / timestep))


def _add_costs(costs: dict[str, list[float]], episode: Episode, start: int, distance: float) -> None:
    squared = np.square(episode.activation[start:])
    costs["mean_squared_activation"].append(float(squared.mean()))
    if distance > 0.0:
        # Σ ∫ a² dt / d [s/m], and positive muscle work over weight and distance (no unit).
        costs["activation_per_metre"].append(float(squared.sum()) * episode.timestep / distance)
        work = float(episode.muscle_power[start:].sum()) * episode.timestep
        costs["work_per_metre"].append(work / (episode.weight * distance))


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _beside(value: float | None, limits: Any) -> dict[str, Any]:
    """A value with the human range."""
    within = None if value is None else bool(limits.least <= value <= limits.most)
    return {
        "value": value,
        "human": [limits.least, limits.most],
        "within": within,
        "unit": limits.unit,
        "source": limits.source,
    }


def _landmarks(curves: dict[str, dict[str, list[Array]]]) -> dict[str, Any]:
    found = {}
    for name, landmark in LANDMARKS.items():
        mean = mean_curve(curves[landmark.curve]["r"] + curves[landmark.curve]["l"])
        value = None if mean is None else extremum(mean[0], landmark.phase, landmark.kind)
        found[name] = _beside(value, landmark.range)
    return found


def _mean_curves(curves: dict[str, dict[str, list[Array]]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, by_side in curves.items():
        out[name] = {}
        for side, found in by_side.items():
            mean = mean_curve(found)
            out[name][side] = None if mean is None else {"mean": mean[0].tolist(), "std": mean[1].tolist()}
    return out


def _asymmetry(curves: dict[str, dict[str, list[Array]]]) -> dict[str, float | None]:
    """Root mean square difference of both sides' mean curves, in the curve's unit."""
    out: dict[str, float | None] = {}
    for name, by_side in curves.items():
        right, left = mean_curve(by_side["r"]), mean_curve(by_side["l"])
        both = right is not None and left is not None
        out[name] = float(np.sqrt(np.mean((right[0] - left[0]) ** 2))) if both and right and left else None
    return out
