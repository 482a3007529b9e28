"""How healthy people walk: measured curves over the gait cycle, and cadence and step length by speed.

The data are in the folder `measured`, whose notice names the papers. Phases are shares of the cycle from foot strike.
"""

import csv
from functools import cache
from importlib import resources
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BOVI: Final = "Bovi et al. 2011 (Gait Posture 33:6), healthy people"
_SCHWARTZ: Final = "Schwartz et al. 2008 (J Biomech 41:1639), children at free speed"
FUKUCHI: Final = "Fukuchi et al. 2018 (PeerJ 6:e4640), young adults"
LOADING: Final = 6
"""First per cent of the vertical force's mean that counts: before, it is an artefact of averaging foot strikes."""


class Curve(NamedTuple):
    """A quantity over the gait cycle in people."""

    mean: Array
    """At each per cent, (101,)."""
    sd: Array
    """Standard deviation between people, (101,)."""
    source: str


class Pace(NamedTuple):
    """Cadence and step length of people at one speed, and their standard deviations."""

    cadence: float
    """Steps per minute [1/min]."""
    cadence_sd: float
    step_length: float
    """[m]."""
    step_length_sd: float


_COLUMNS: Final = {
    "hip_flexion": ("bovi2011_kinematics.csv", "hip", _BOVI),
    "knee_flexion": ("bovi2011_kinematics.csv", "knee", _BOVI),
    "ankle_dorsiflexion": ("bovi2011_kinematics.csv", "ankle", _BOVI),
    "pelvis_tilt": ("bovi2011_kinematics.csv", "pelvis_tilt_anterior", _BOVI),
    "vertical_force": ("bovi2011_vgrf.csv", "vgrf", _BOVI),
    "forward_force": ("schwartz2008_children_free.csv", "foreaft_grf", _SCHWARTZ),
    "hip_adduction": ("schwartz2008_children_free.csv", "hip_adduction", _SCHWARTZ),
}
EMG: Final = {
    "rectfem": "rectus_femoris",
    "hamstrings": "medial_hamstrings",
    "tibant": "tibialis_anterior",
    "gastroc": "medial_gastrocnemius",
}
"""Muscles of myoleg26 whose electromyogram was measured, and the name of its column."""
ALIASES: Final = {
    "rectfem": ("rectfem", "recfem"),
    "hamstrings": ("hamstrings", "semimem"),
    "tibant": ("tibant",),
    "gastroc": ("gastroc", "gasmed"),
}
"""Names that a muscle of `EMG` has in models: the first there is counts."""


@cache
def curve(name: str) -> Curve:
    """A joint angle [°] or a force [body weights] over the cycle; `hip_flexion` is that against the pelvis."""
    file, column, source = _COLUMNS[name]
    return _curve(file, column, source)


@cache
def envelope(muscle: str) -> Curve:
    """The electromyogram of a muscle of `EMG` over the cycle, in a unit that is not stated: its shape counts."""
    return _curve("schwartz2008_children_free.csv", EMG[muscle], _SCHWARTZ)


@cache
def pace_polynomials() -> tuple[Array, Array]:
    """Coefficients, highest power first, of cadence [1/min] and step length [m] as parabolas of the speed [m/s].

    They are fitted to the means of the six speed classes of young adults, 0.49 to 1.42 m/s.
    """
    rows = [
        row for row in _rows("fukuchi2018_pace.csv") if row["age_group"] == "Young" and row["speed_class"][0] == "V"
    ]
    speed, cadence, step = (
        np.array([float(row[name]) for row in rows])
        for name in ("speed_m_s_mean", "cadence_steps_min_mean", "step_length_m_mean")
    )
    return np.polyfit(speed, cadence, 2), np.polyfit(speed, step, 2)


def pace(speed: float) -> Pace:
    """How young adults walk at a speed [m/s]; the spread between people is that of their trials nearest 1.25 m/s."""
    cadence, step = pace_polynomials()
    (row,) = (
        row
        for row in _rows("fukuchi2018_pace.csv")
        if row["age_group"] == "Young" and row["speed_class"] == "nearest_1.25"
    )
    return Pace(
        float(np.polyval(cadence, speed)),
        float(row["cadence_steps_min_sd"]),
        float(np.polyval(step, speed)),
        float(row["step_length_m_sd"]),
    )


def _curve(file: str, column: str, source: str) -> Curve:
    rows = _rows(file)
    at, mean, sd = (
        np.array([float(row[name]) for row in rows]) for name in ("percent", f"{column}_mean", f"{column}_sd")
    )
    every = np.arange(101)
    return Curve(np.interp(every, at, mean), np.interp(every, at, sd), source)


@cache
def _rows(file: str) -> list[dict[str, str]]:
    text = (resources.files(__package__) / "measured" / file).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))
