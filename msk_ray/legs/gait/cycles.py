"""Find gait cycles in the time series of one episode: pure functions.

Axes: T equally spaced samples.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

POINTS = 101
"""Samples of a cycle: one per percent, both ends included."""
_LOAD = 0.05
"""Load from which a foot is on the ground, in body weights."""


class Stride(NamedTuple):
    """From one foot strike to the next of the same foot, as sample indices."""

    start: int
    toe_off: int
    """First sample of the swing."""
    end: int

    @property
    def samples(self) -> int:
        """Its duration in samples."""
        return self.end - self.start

    @property
    def duty(self) -> float:
        """Share of the stride during which the foot is on the ground."""
        return (self.toe_off - self.start) / self.samples


def on_ground(force: Array, weight: float, *, least: int) -> Flags:
    """Whether a foot bears load, shape (T,), from its vertical force (T,) [N].

    Args:
        force: ground reaction force of the foot.
        weight: of the body [N].
        least: contacts and gaps shorter than this many samples are chatter and are removed, gaps first.
    """
    flags = force > _LOAD * weight
    for value in (False, True):
        start = 0
        for end in range(1, len(flags) + 1):
            if end < len(flags) and flags[end] == flags[start]:
                continue
            inside = start > 0 and end < len(flags)
            if inside and flags[start] == value and end - start < least:
                flags[start:end] = not value
            start = end
    return flags


def strikes(contact: Flags) -> NDArray[np.int64]:
    """Samples at which a foot comes down."""
    return np.flatnonzero(contact[1:] & ~contact[:-1]) + 1


def strides(contact: Flags) -> list[Stride]:
    """Complete strides of a foot."""
    starts = strikes(contact)
    found = []
    for start, end in pairwise(starts):
        lifted = np.flatnonzero(~contact[start:end])
        found.append(Stride(int(start), int(start + lifted[0]), int(end)))
    return found


def over_cycle(values: Array, stride: Stride) -> Array:
    """Values (T,) of a stride at each percent of it, shape (101,)."""
    at = np.linspace(stride.start, stride.end, POINTS)
    return np.interp(at, np.arange(len(values)), values)


def step_lengths(contact: Flags, own: Array, other: Array) -> Array:
    """How far a foot is ahead of the other when it comes down [m], from the positions of both feet (T,)."""
    at = strikes(contact)
    return own[at] - other[at]


def cadence(right: Flags, left: Flags, timestep: float) -> float | None:
    """Steps per minute between the first strike of any foot and the last; None with no time between them."""
    at = np.sort(np.concatenate((strikes(right), strikes(left))))
    if len(at) < 2 or at[0] == at[-1]:
        return None
    return 60.0 * (len(at) - 1) / float((at[-1] - at[0]) * timestep)


def symmetry_index(right: float, left: float) -> float | None:
    """Robinson's index [%]: difference of both sides over their mean size; 0 is symmetric, None if both are zero."""
    size = (abs(right) + abs(left)) / 2.0
    return 100.0 * abs(right - left) / size if size > 0.0 else None


def mean_curve(curves: Sequence[Array]) -> tuple[Array, Array] | None:
    """Mean and standard deviation (101,) over strides; None without any."""
    if not curves:
        return None
    stacked = np.stack(curves)
    return stacked.mean(0), stacked.std(0)


def extremum(curve: Array, phase: tuple[float, float], kind: str) -> float:
    """Largest (`max`) or smallest (`min`) value of a curve (101,) between two phases [%], or `at` the first of them."""
    first, last = round(phase[0]), round(phase[1])
    part = curve[first : last + 1]
    if kind == "at":
        return float(part[0])
    return float(part.max() if kind == "max" else part.min())
