"""What the numbers of an observation mean."""

from collections.abc import Iterable
from typing import NamedTuple

import mujoco


class Entry(NamedTuple):
    """One number of an observation."""

    name: str
    unit: str
    """Unit of the number as it stands there; empty if it has none."""


def entries(names: Iterable[str], unit: str = "") -> list[Entry]:
    """Entries of one unit."""
    return [Entry(name, unit) for name in names]


def vector(name: str, unit: str = "") -> list[Entry]:
    """The three entries of a vector in world coordinates."""
    return entries((f"{name}_x", f"{name}_y", f"{name}_z"), unit)


def floating_body(model: mujoco.MjModel) -> list[Entry]:
    """Height, orientation and velocities of a torso with a free joint, then angles and rates × 0.1 of its hinges."""
    hinges = [model.joint(i).name for i in range(1, model.njnt)]
    return [
        Entry("torso_height", "m"),
        *entries(f"torso_quaternion_{axis}" for axis in "wxyz"),
        *vector("torso_velocity", "m/s"),
        *vector("torso_angular_velocity", "rad/s"),
        *entries((f"{name}_angle" for name in hinges), "rad"),
        *entries((f"{name}_rate" for name in hinges), "10 rad/s"),
    ]
