"""The type of an observation's entries, and helpers to list them. Each environment lists its own in
`observation_layout`."""

from collections.abc import Iterable
from typing import NamedTuple


class Entry(NamedTuple):
    """One number of an observation."""

    name: str
    unit: str
    """Unit of the number as observed, after any scaling; empty if it has none."""
    known: bool = False
    """Whether the policy knows the number without measuring it: its last action, a command, a memory. Errors and delays
    of observations do not change it."""


def entries(names: Iterable[str], unit: str = "") -> list[Entry]:
    """Entries that have the same unit."""
    return [Entry(name, unit) for name in names]


def known(layout: Iterable[Entry]) -> list[Entry]:
    """The same entries, marked as known without measuring, such as the frames of a history."""
    return [entry._replace(known=True) for entry in layout]


def each(names: Iterable[str], what: str, unit: str = "") -> list[Entry]:
    """One entry for each name, called NAME_WHAT."""
    return entries((f"{name}_{what}" for name in names), unit)


def vector(name: str, unit: str = "") -> list[Entry]:
    """The entries NAME_x, NAME_y and NAME_z of a vector."""
    return entries((f"{name}_x", f"{name}_y", f"{name}_z"), unit)
