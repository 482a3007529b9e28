"""Operators over lists of values."""

from dataclasses import dataclass

from msk_ray.sweep.operators.base import NamedValues


@dataclass(frozen=True)
class Grid(NamedValues):
    """Tries every value, in all combinations with other grids."""

    enumerated = True


@dataclass(frozen=True)
class Choice(NamedValues):
    """Draws one value for each trial."""
