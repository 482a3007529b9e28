"""What a velocity task needs to know of a robot. No torch: settings read it."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from msk_ray.errors import ConfigError


@dataclass(frozen=True)
class PoseSpread:
    """Spread of joint angles about the default pose that the term `pose` tolerates [rad], by patterns of names."""

    standing: Mapping[str, float]
    """Where the command is below 0.05 m/s plus rad/s."""
    walking: Mapping[str, float]
    running: Mapping[str, float]
    """Where the command is 1.5 m/s plus rad/s or more."""


@dataclass(frozen=True)
class Robot:
    """Names in the robot's MJCF."""

    base: str
    """Body with the free joint."""
    trunk: str
    """Body that is to stay upright."""
    feet: tuple[str, ...]
    """Sites under the feet, F of them."""
    foot_parts: tuple[str, ...]
    """What of each foot touches the ground."""
    foot_kind: Literal["geom", "subtree"]
    """Whether these are geoms or bodies."""
    pose_spread: PoseSpread


def by_joint(values: Mapping[str, float], joints: Sequence[str]) -> list[float]:
    """The value of each joint: that of the one pattern which its whole name matches.

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
