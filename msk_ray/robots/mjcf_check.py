"""What a robot's MJCF lacks or has wrong, said when its environment is made."""

from collections.abc import Iterable, Mapping, Sequence

import mujoco

from msk_ray.errors import ConfigError, shortened
from msk_ray.robots.robot import Robot

GROUND = "terrain"
"""Body with the ground."""
_TOLERANCE = 1e-4
"""By which a keyframe, written in decimals, may be beyond a range [rad]."""


def check_default_pose(owner: str, model: mujoco.MjModel, qpos: Sequence[float] | None) -> None:
    """Check the pose of the keyframe that a class's episodes begin with; None if it has no keyframe.

    Raises:
        ConfigError: there is none, or a joint is outside its range in it.
    """
    if qpos is None:
        raise ConfigError(
            f"the model of {owner} has no keyframe with the default pose, in which the robot stands: write in the MJCF "
            f'<keyframe><key qpos="0 0 HEIGHT 1 0 0 0 ANGLES"/></keyframe>, {model.nq} numbers, angles in rad'
        )
    outside = [
        f"joint {model.joint(joint).name!r} is at {angle:.4g} rad, outside its range {low:.4g} to {high:.4g} rad"
        for joint, (low, high) in enumerate(model.jnt_range)
        if model.jnt_limited[joint]
        and not low - _TOLERANCE <= (angle := qpos[model.jnt_qposadr[joint]]) <= high + _TOLERANCE
    ]
    if outside:
        others = f", and so are {len(outside) - 1} others" if len(outside) > 1 else ""
        raise ConfigError(
            f"the default pose of {owner}: {outside[0]}{others}: change the keyframe or the range (angles in an MJCF "
            'are degrees unless <compiler angle="radian"/>; those of keyframes are always rad)'
        )


def missing_parts(robot: Robot, model: mujoco.MjModel) -> list[str]:
    """The names of a robot that its model lacks, in one text for each kind of part."""
    ground, parts = {GROUND: "with the ground"}, dict.fromkeys(robot.foot_parts, "")
    bodies = dict.fromkeys((robot.base, robot.trunk), "") | ground
    kinds = {"body": bodies, "site": dict.fromkeys(robot.feet, "")}
    if robot.foot_kind == "subtree":
        bodies |= parts
    else:
        kinds["geom"] = parts
    return [text for kind, names in kinds.items() if (text := missing(kind, names, model)) is not None]


def missing(kind: str, names: Mapping[str, str], model: mujoco.MjModel) -> str | None:
    """Which of some names, with a word on what each is, no part of a kind has in the model; None if all are there."""
    known = _names(kind, model)
    lacking = [f"{name!r} ({what})" if what else repr(name) for name, what in names.items() if name not in known]
    if not lacking:
        return None
    return f"no {kind} {', '.join(lacking)} (it has {shortened(', '.join(known) or 'none with a name', 200)})"


def _names(kind: str, model: mujoco.MjModel) -> list[str]:
    """Names of all parts of a kind, in their order."""
    count = {"body": model.nbody, "site": model.nsite, "geom": model.ngeom, "sensor": model.nsensor}[kind]
    each: Iterable[str] = (getattr(model, kind)(i).name for i in range(count))
    return list(filter(None, each))
