"""A gait beside that of people: differences of curves over the cycle, and one number for all of them.

The gait distance is the root mean square of these, each in standard deviations of people and at most `FARTHEST`: the
root mean square difference over the cycle of hip flexion and ankle dorsiflexion (both with their mean over the cycle
removed, because their zero differs between models of the pelvis and foot), knee flexion and vertical force; cadence and
step length, compared with people at the same speed; duty factor; and the difference between right and left steps, in
units of 5 %. A healthy person is at about 1. What could not be measured, as without strides, counts as `FARTHEST`.
"""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from msk_ray.legs.gait.people import EMG, FUKUCHI, LOADING, curve, envelope, pace

Array = NDArray[np.float64]

FARTHEST: Final = 10.0
"""Largest difference that counts, in standard deviations."""
BAND: Final = 2.0
"""Standard deviations on either side of the mean of people within which a curve is inside."""
CENTRED: Final = ("hip_flexion", "ankle_dorsiflexion")
"""Curves whose mean over the cycle is left out of the distance."""
JUDGED: Final = ("hip_flexion", "knee_flexion", "ankle_dorsiflexion", "vertical_force")
_LEAST_SD: Final = {"vertical_force": 0.03, "forward_force": 0.01}
"""Smallest standard deviation of a force [body weights]: in swing that of people is 0."""
_DUTY: Final = (0.62, 0.02)
"""Mean and standard deviation of the duty factor: 0.58 to 0.66 spans the 0.59 of Schwartz et al. 2008 and the 0.62 of
adults (Perry & Burnfield 2010)."""
_ASYMMETRY: Final = 5.0
"""Unit of the symmetry index [%]: at twice of it, a gait counts as asymmetric (Robinson et al. 1987)."""


class Difference(NamedTuple):
    """How a curve differs from the mean of people; "centred" is with the means of both removed."""

    rmse: float
    """In the curve's unit."""
    rmse_centred: float
    correlation: float | None
    """Pearson's; None for a constant curve."""
    within: float
    """Share of the cycle inside the mean ± 2 SD of people."""
    within_centred: float
    deviations: float
    """Root mean square difference in standard deviations of people."""
    deviations_centred: float


def difference(name: str, mean: Array) -> Difference:
    """How a mean curve (101,) of `people.curve` `name` differs from people's."""
    people = curve(name)
    first = LOADING if name == "vertical_force" else 0
    own, other = mean[first:], people.mean[first:]
    sd = np.maximum(people.sd[first:], _LEAST_SD.get(name, 0.0))
    apart = own - other
    centred = apart - apart.mean()
    varies = own.std() > 1e-9
    return Difference(
        _rms(apart),
        _rms(centred),
        float(np.corrcoef(own, other)[0, 1]) if varies else None,
        float(np.mean(np.abs(apart) <= BAND * sd)),
        float(np.mean(np.abs(centred) <= BAND * sd)),
        _rms(apart / sd),
        _rms(centred / sd),
    )


def at_speed(speed: float | None, cadence: float | None, step_length: float | None) -> dict[str, Any]:
    """Cadence [1/min] and step length [m] beside those of people at that speed [m/s], with ± 2 SD."""
    if speed is None or speed <= 0.0:
        return {}
    people = pace(speed)
    found = {}
    for name, value, mean, sd in (
        ("cadence", cadence, people.cadence, people.cadence_sd),
        ("step_length", step_length, people.step_length, people.step_length_sd),
    ):
        apart = None if value is None else (value - mean) / sd
        limits = [mean - BAND * sd, mean + BAND * sd]
        within = None if apart is None else abs(apart) <= BAND
        found[name] = {"value": value, "people": limits, "within": within, "deviations": apart, "source": FUKUCHI}
    return found


def gait_distance(
    differences: Mapping[str, Difference],
    beside: Mapping[str, Any],
    duty: float | None,
    asymmetry: float | None,
) -> tuple[float, dict[str, float]]:
    """The gait distance and its parts, in standard deviations of people.

    Args:
        differences: of the curves of `JUDGED` that were measured.
        beside: of `at_speed`.
        duty: duty factor.
        asymmetry: symmetry index of the step length [%].
    """
    parts: dict[str, float | None] = dict.fromkeys(JUDGED)
    for name, found in differences.items():
        if name in parts:
            parts[name] = found.deviations_centred if name in CENTRED else found.deviations
    for name in ("cadence", "step_length"):
        parts[name] = beside[name]["deviations"] if name in beside else None
    parts["duty_factor"] = None if duty is None else (duty - _DUTY[0]) / _DUTY[1]
    parts["asymmetry"] = None if asymmetry is None else asymmetry / _ASYMMETRY
    counted = {name: FARTHEST if z is None else min(abs(z), FARTHEST) for name, z in parts.items()}
    return _rms(np.array(list(counted.values()))), counted


def timing(muscle: str, activation: Array) -> float | None:
    """Correlation of a muscle's mean activation (101,) with people's electromyogram; None if it is constant.

    Args:
        muscle: one of `people.EMG`.
        activation: over the cycle of its leg.
    """
    assert muscle in EMG
    return float(np.corrcoef(activation, envelope(muscle).mean)[0, 1]) if activation.std() > 1e-9 else None


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
