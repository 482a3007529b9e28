"""Operators over values that are written out."""

from dataclasses import dataclass

from msk_ray.sweep.operators.base import Listed


@dataclass(frozen=True)
class Grid(Listed):
    """Every value is tried, in every combination with other grids."""

    enumerated = True


@dataclass(frozen=True)
class Choice(Listed):
    """One value is drawn for each trial."""
