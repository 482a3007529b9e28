"""What the numbers of an observation mean."""

from collections.abc import Iterable
from typing import NamedTuple


class Entry(NamedTuple):
    """One number of an observation."""

    name: str
    unit: str
    """Unit of the number as it stands there; empty if it has none."""
    remembered: bool = False
    """Whether it is shown as a memory has it: errors and delays of observations leave it as it is."""


def entries(names: Iterable[str], unit: str = "") -> list[Entry]:
    """Entries of one unit."""
    return [Entry(name, unit) for name in names]


def remembered(shown: Iterable[Entry]) -> list[Entry]:
    """The same entries as memories have them, such as frames of a history."""
    return [entry._replace(remembered=True) for entry in shown]


def each(names: Iterable[str], what: str, unit: str = "") -> list[Entry]:
    """One entry for each of several things, NAME_WHAT."""
    return entries((f"{name}_{what}" for name in names), unit)


def vector(name: str, unit: str = "") -> list[Entry]:
    """The three entries of a vector in world coordinates."""
    return entries((f"{name}_x", f"{name}_y", f"{name}_z"), unit)
