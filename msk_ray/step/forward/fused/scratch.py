"""What a world's lanes keep between their loops, in memory that is allocated once."""

from typing import Any

import warp as wp
from msk_ray.step.errors import ConfigError

from msk_ray.step.forward.fused.lanes import WARP

CONE = wp.constant(10)
"""Numbers that the line search keeps of each elliptic contact."""
_MOST = 2**31 - 1


@wp.struct
class Scratch:
    """For W worlds of R rows, C elliptic contacts, and P degrees of freedom in whole fours. Every array is (W, ...)."""

    inertia: wp.array2d[float]
    """M, symmetric, P²."""
    factor: wp.array2d[float]
    """The lower triangle of the Hessian, and then L D of its factors L D Lᵀ, column by column, P²."""
    pivot: wp.array2d[float]
    """Reciprocals of D, P."""
    rows: wp.array2d[float]
    """The rows whose weighted squares add to the Hessian: J, but other ones where a contact slides, R P."""
    jar: wp.array2d[float]
    """J a - aref, R."""
    rate: wp.array2d[float]
    """J times the direction, R."""
    weight: wp.array2d[float]
    """Weight of each of `rows`, R."""
    bound: wp.array2d[float]
    """μ in the first row of an elliptic contact, and the coefficients of friction in its others, R."""
    cones: wp.array2d[float]
    """What the line search knows of each elliptic contact, 10 C."""
    leaning: wp.array2d[float]
    """1 / T of each elliptic contact that slides; -1 where one has just ceased to, 0 of the others, C."""
    first: wp.array2d[int]
    """First row of each elliptic contact, C."""
    end: wp.array2d[int]
    """The row after its last, C."""
    acc: wp.array2d[float]
    """Acceleration a, P."""
    inertial: wp.array2d[float]
    """M a, P."""
    push: wp.array2d[float]
    """Jᵀ f, P."""
    gradient: wp.array2d[float]
    """M a - τ - Jᵀ f, P."""
    partial: wp.array2d[float]
    """What is left of a system of equations while it is solved, P."""
    direction: wp.array2d[float]
    """Newton's direction, P."""
    moved: wp.array2d[float]
    """M times the direction, P."""


def padded(nv: int) -> int:
    """Degrees of freedom in whole fours."""
    return -(-nv // 4) * 4


def make_scratch(worlds: int, rows: int, nv: int) -> Any:
    """Arrays for as many worlds, rows a world and degrees of freedom, on the current device.

    Raises:
        ConfigError: the threads would be too many to be counted in 32 bits.
    """
    if worlds * WARP > _MOST:
        raise ConfigError(
            f"the fused solver has room for {_MOST // WARP} worlds: take fewer, or write "
            "physics.solver_kernels: mujoco_warp"
        )
    width, contacts = padded(nv), rows // 3 + 1  # an elliptic contact has 3 rows or more
    widths = {"inertia": width * width, "factor": width * width, "rows": rows * width, "cones": CONE * contacts}
    widths |= dict.fromkeys(("leaning", "first", "end"), contacts)
    widths |= dict.fromkeys(("pivot", "acc", "inertial", "push", "gradient", "partial", "direction", "moved"), width)
    kind: Any = Scratch
    scratch = kind()
    for name, field in kind.vars.items():
        setattr(scratch, name, wp.zeros((worlds, widths.get(name, rows)), dtype=field.type.dtype))
    return scratch
