"""Checks that a robot's MJCF has what its environment needs."""

from collections.abc import Iterable, Mapping, Sequence

import mujoco

from msk_ray.errors import ConfigError, shortened
from msk_ray.robots.robot import Robot

GROUND = "terrain"
"""Name of the body with the ground."""
_ROUNDING = 1e-4
"""Angle by which a keyframe may exceed a joint's range, because its decimals are rounded [rad]."""


def check_default_pose(owner: str, model: mujoco.MjModel, qpos: Sequence[float] | None) -> None:
    """Check the keyframe that episodes begin with.

    Args:
        owner: name of the environment's class, for messages.
        model: its model.
        qpos: pose of the keyframe, (nq,); None: the model has no keyframe.

    Raises:
        ConfigError: there is no keyframe, or it puts a joint outside its range.
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
        and not low - _ROUNDING <= (angle := qpos[model.jnt_qposadr[joint]]) <= high + _ROUNDING
    ]
    if outside:
        others = f", and so are {len(outside) - 1} others" if len(outside) > 1 else ""
        raise ConfigError(
            f"the default pose of {owner}: {outside[0]}{others}: change the keyframe or the range (angles in an MJCF "
            'are degrees unless <compiler angle="radian"/>; those of keyframes are always rad)'
        )


def missing_parts(robot: Robot, model: mujoco.MjModel) -> list[str]:
    """Names in `robot` that its model lacks: one sentence for each kind of part that is missing."""
    ground, parts = {GROUND: "with the ground"}, dict.fromkeys(robot.foot_parts, "")
    bodies = dict.fromkeys((robot.base, robot.trunk), "") | ground
    kinds = {"body": bodies, "site": dict.fromkeys(robot.feet, "")}
    if robot.foot_kind == "subtree":
        bodies |= parts
    else:
        kinds["geom"] = parts
    return [text for kind, names in kinds.items() if (text := missing(kind, names, model)) is not None]


def missing(kind: str, names: Mapping[str, str], model: mujoco.MjModel) -> str | None:
    """A sentence on the names that the model lacks; None if it has all.

    Args:
        kind: kind of the parts: body, site, geom or sensor.
        names: names to look for, each with what it stands for, or "".
        model: the model.
    """
    known = _names(kind, model)
    lacking = [f"{name!r} ({what})" if what else repr(name) for name, what in names.items() if name not in known]
    if not lacking:
        return None
    return f"no {kind} {', '.join(lacking)} (it has {shortened(', '.join(known) or 'none with a name', 200)})"


def _names(kind: str, model: mujoco.MjModel) -> list[str]:
    """Names of the parts of a kind that have one, in the model's order."""
    count = {"body": model.nbody, "site": model.nsite, "geom": model.ngeom, "sensor": model.nsensor}[kind]
    names: Iterable[str] = (getattr(model, kind)(i).name for i in range(count))
    return list(filter(None, names))
