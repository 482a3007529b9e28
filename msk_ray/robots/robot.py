"""What a velocity task needs to know of a robot. No torch: settings read it."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from msk_ray.errors import ConfigError


@dataclass(frozen=True)
class PoseSpread:
    """Spread of joint angles about the default pose that the term `pose` tolerates [rad], by pattern of joint names."""

    standing: Mapping[str, float]
    """For commanded speeds, in m/s plus rad/s, below 0.05."""
    walking: Mapping[str, float]
    """For commanded speeds from 0.05 to 1.5."""
    running: Mapping[str, float]
    """For commanded speeds of 1.5 and more."""


@dataclass(frozen=True)
class Robot:
    """Names in the robot's MJCF."""

    base: str
    """Body with the free joint."""
    trunk: str
    """Body that should stay upright."""
    feet: tuple[str, ...]
    """Sites under the feet, F of them."""
    foot_parts: tuple[str, ...]
    """The part of each foot that touches the ground."""
    foot_kind: Literal["geom", "subtree"]
    """What `foot_parts` names: geoms, or bodies that count with all bodies below them."""
    pose_spread: PoseSpread


def by_joint(values: Mapping[str, float], joints: Sequence[str]) -> list[float]:
    """The value for each joint, from the pattern that matches its whole name.

    Raises:
        ConfigError: no pattern matches a joint, or several do.
    """
    chosen = []
    for joint in joints:
        matching = [pattern for pattern in values if re.fullmatch(pattern, joint)]
        if len(matching) != 1:
            which = f"{len(matching)} patterns match" if matching else "no pattern matches"
            raise ConfigError(f"pose_spread: {which} joint {joint!r}; write one of {', '.join(values)} that does")
        chosen.append(values[matching[0]])
    return chosen
