"""Gait measures over episodes."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from msk_ray.legs.gait.body import CURVES, SIDES, Array, Episode
from msk_ray.legs.gait.compare import at_speed, difference, gait_distance, timing
from msk_ray.legs.gait.cycles import (
    Flags,
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
from msk_ray.legs.gait.people import EMG
from msk_ray.legs.gait.ranges import LANDMARKS, MEASURES
from msk_ray.legs.metabolic import BASAL

SETTLING = 1.0
"""Start of an episode that is left out [s], so that the settled gait is measured."""
_SHORTEST = 0.06
"""Contacts and gaps that are shorter are chatter [s]: no step or swing is."""


def measure(episodes: Sequence[Episode], fell: Sequence[bool]) -> dict[str, Any]:
    """Measures over all episodes, JSON types only; null for what no episode contained.

    Args:
        episodes: time series, each up to its end.
        fell: whether each ended in a fall.

    Returns:
        `measures`: value, human range, unit, source and whether the value is in the range, for speed, cadence, step
        length, duty factor and symmetry. `landmarks`: the same for points of the curves. `curves`: mean and standard
        deviation over strides at each percent of the cycle, by side. `people`: how the mean of both sides differs from
        people's, by curve (`compare.Difference`). `at_speed`: cadence and step length beside people's at that speed.
        `gait_distance` and `gait_distance_parts` (`compare.gait_distance`). `activations`: as `curves`, of muscles
        whose electromyogram is known, and `timing`, their correlation with it. `costs`, `falls`, `strides`, `episodes`.
    """
    values: dict[str, list[float]] = {"speed": [], "cadence": []}
    sided: dict[str, dict[str, list[float]]] = {
        name: {side: [] for side in SIDES} for name in ("step_length", "duty_factor")
    }
    curves: dict[str, dict[str, list[Array]]] = {name: {side: [] for side in SIDES} for name in CURVES}
    names = ("mean_squared_activation", "activation_per_metre", "work_per_metre", "cost_of_transport")
    costs: dict[str, list[float]] = {name: [] for name in names}
    muscles: dict[str, dict[str, list[Array]]] = {name: {side: [] for side in SIDES} for name in EMG}
    count = 0
    for episode in episodes:
        start = settled(episode)
        if len(episode.forward) - start < 2:
            continue
        seconds = (len(episode.forward) - 1 - start) * episode.timestep
        distance = float(episode.forward[-1] - episode.forward[start])
        values["speed"].append(distance / seconds)
        _add_costs(costs, episode, start, distance)
        contact = {side: contacts(episode, side) for side in SIDES}
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
            for name, activations in episode.muscles.items():
                muscles[name][side] += [over_cycle(activations[side][start:], stride) for stride in found]
    measures = {name: _mean(found) for name, found in values.items()}
    for name, by_side in sided.items():
        measures[name] = _mean(by_side["r"] + by_side["l"])
        right, left = _mean(by_side["r"]), _mean(by_side["l"])
        both = right is not None and left is not None
        measures[f"symmetry_{name}"] = symmetry_index(right or 0.0, left or 0.0) if both else None
    beside = at_speed(measures["speed"], measures["cadence"], measures["step_length"])
    differences = {name: difference(name, mean[0]) for name, mean in _both_sides(curves).items()}
    distance, parts = gait_distance(differences, beside, measures["duty_factor"], measures["symmetry_step_length"])
    return {
        "gait_distance": distance,
        "gait_distance_parts": parts,
        "people": {name: found._asdict() for name, found in differences.items()},
        "at_speed": beside,
        "activations": _mean_curves(muscles),
        "timing": {name: timing(name, mean[0]) for name, mean in _both_sides(muscles).items()},
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


def summary(gait: dict[str, Any]) -> dict[str, float]:
    """The figures of a `measure` that are followed during training; without those that were not measured."""
    values = {
        "gait_distance": gait["gait_distance"],
        **{name: gait["measures"][name]["value"] for name in ("cadence", "step_length", "duty_factor")},
        "asymmetry": gait["measures"]["symmetry_step_length"]["value"],
        "cost_of_transport": gait["costs"]["cost_of_transport"],
    }
    return {name: value for name, value in values.items() if value is not None}


def _both_sides(curves: dict[str, dict[str, list[Array]]]) -> dict[str, tuple[Array, Array]]:
    """Mean and standard deviation over the strides of both legs, of the curves that have any."""
    means = {name: mean_curve(by_side["r"] + by_side["l"]) for name, by_side in curves.items()}
    return {name: mean for name, mean in means.items() if mean is not None}


def settled(episode: Episode) -> int:
    """The first sample of the settled gait."""
    return round(SETTLING / episode.timestep)


def contacts(episode: Episode, side: str) -> Flags:
    """Whether a foot bears load, from sample `settled` on."""
    least = max(1, round(_SHORTEST / episode.timestep))
    return on_ground(episode.curves["vertical_force"][side][settled(episode) :], 1.0, least=least)


def _add_costs(costs: dict[str, list[float]], episode: Episode, start: int, distance: float) -> None:
    squared = np.square(episode.activation[start:])
    costs["mean_squared_activation"].append(float(squared.mean()))
    if distance > 0.0:
        # Σ ∫ a² dt / d [s/m], and positive muscle work over weight and distance (no unit).
        costs["activation_per_metre"].append(float(squared.sum()) * episode.timestep / distance)
        work = float(episode.muscle_power[start:].sum()) * episode.timestep
        costs["work_per_metre"].append(work / (episode.weight * distance))
        # Gross metabolic energy over weight and distance (no unit).
        energy = float(episode.metabolic_power[start:].sum()) * episode.timestep
        rest = BASAL * episode.weight / 9.81 * (len(squared) * episode.timestep)
        costs["cost_of_transport"].append((energy + rest) / (episode.weight * distance))


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
