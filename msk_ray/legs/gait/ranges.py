"""How people walk: published ranges of healthy adults at free speed on level ground.

Textbook figures for a quick comparison. They were entered without the printed tables at hand, so check the source
before quoting a limit. As a check, the means measured by Murray, Drought & Kory (1964, men) and Murray, Kory & Sepic
(1970, women) are inside them (1.54 and 1.31 m/s, 117 steps per minute, steps of 0.79 and 0.66 m).
"""

from typing import Final, NamedTuple

_WHITTLE: Final = "Whittle, Gait analysis: an introduction; men of 18 to 49 years at free speed, 95 % limits"
_PERRY: Final = "Perry & Burnfield 2010, Gait analysis: normal and pathological function"


class Range(NamedTuple):
    """The range of most healthy adults."""

    least: float
    most: float
    unit: str
    source: str


MEASURES: Final = {
    "speed": Range(1.10, 1.82, "m/s", _WHITTLE),
    "cadence": Range(91.0, 135.0, "steps/min", _WHITTLE),
    "step_length": Range(0.625, 0.925, "m", _WHITTLE + ": half a stride of 1.25 to 1.85 m"),
    "duty_factor": Range(0.58, 0.64, "of a stride", _PERRY + ": stance is about 62 % of a stride"),
    "symmetry_step_length": Range(0.0, 10.0, "%", "Robinson et al. 1987 (J Manipulative Physiol Ther 10:172)"),
    "symmetry_duty_factor": Range(0.0, 10.0, "%", "Robinson et al. 1987 (J Manipulative Physiol Ther 10:172)"),
}


class Landmark(NamedTuple):
    """A point of a curve over the gait cycle that people share."""

    curve: str
    phase: tuple[float, float]
    """Percentages of the cycle between which it is looked for."""
    kind: str
    """`max`, `min`, or `at` the first phase."""
    range: Range


LANDMARKS: Final = {
    "hip_at_strike": Landmark("hip_flexion", (0, 0), "at", Range(20.0, 35.0, "°", _PERRY)),
    "hip_most_extended": Landmark("hip_flexion", (40, 65), "min", Range(-20.0, -5.0, "°", _PERRY)),
    "knee_in_loading": Landmark("knee_flexion", (5, 25), "max", Range(10.0, 25.0, "°", _PERRY)),
    "knee_in_swing": Landmark("knee_flexion", (60, 90), "max", Range(55.0, 70.0, "°", _PERRY)),
    "ankle_in_stance": Landmark("ankle_dorsiflexion", (30, 55), "max", Range(5.0, 15.0, "°", _PERRY)),
    "ankle_at_push_off": Landmark("ankle_dorsiflexion", (55, 75), "min", Range(-25.0, -10.0, "°", _PERRY)),
    "force_first_peak": Landmark("vertical_force", (5, 30), "max", Range(1.0, 1.3, "body weights", _WHITTLE)),
    "force_valley": Landmark("vertical_force", (20, 45), "min", Range(0.6, 0.9, "body weights", _WHITTLE)),
    "force_second_peak": Landmark("vertical_force", (40, 60), "max", Range(1.0, 1.3, "body weights", _WHITTLE)),
}
