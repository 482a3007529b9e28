"""Scratch memory of the worlds, allocated once."""

from typing import Any

import warp as wp

from msk_ray.step.errors import ConfigError
from msk_ray.step.forward.fused.lanes import WARP

CONE = wp.constant(10)
"""Numbers per elliptic contact that the line search stores."""
_MOST = 2**31 - 1


@wp.struct
class Scratch:
    """Scratch for W worlds of R rows, C elliptic contacts, and P: nv rounded up to a multiple of four. Arrays are (W,
    ...)."""

    inertia: wp.array2d[float]
    """M, symmetric, P²."""
    factor: wp.array2d[float]
    """The lower triangle of the Hessian, then L D of its factors L D Lᵀ, symmetric, P²."""
    pivot: wp.array2d[float]
    """Reciprocals of D, P."""
    squared: wp.array2d[float]
    """With elliptic cones, `Rows.squared`, R times its stride."""
    jar: wp.array2d[float]
    """J a - aref, R."""
    rate: wp.array2d[float]
    """J times the direction, R."""
    weight: wp.array2d[float]
    """Weight of each of `Rows.squared`, R."""
    bound: wp.array2d[float]
    """μ in the first row of an elliptic contact, the friction coefficients in its other rows, R."""
    cones: wp.array2d[float]
    """Coefficients of each elliptic contact for the line search, 10 C."""
    leaning: wp.array2d[float]
    """1 / T for sliding elliptic contacts; -1 for those that have just stopped sliding, 0 for others, C."""
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
    direction: wp.array2d[float]
    """Newton's direction, P."""
    moved: wp.array2d[float]
    """M times the direction, P."""


def padded(nv: int) -> int:
    """nv rounded up to a multiple of four."""
    return -(-nv // 4) * 4


def make_scratch(worlds: int, rows: int, nv: int, stride: int) -> Any:
    """Arrays for these numbers of worlds, rows per world and degrees of freedom, on the current device.

    Args:
        stride: length of each row of `squared`; 0 for a model without elliptic cones.

    Raises:
        ConfigError: there are too many threads for 32-bit indices.
    """
    if worlds * WARP > _MOST:
        raise ConfigError(
            f"the fused solver has room for {_MOST // WARP} worlds: take fewer, or write "
            "execution.solver_kernels: mujoco_warp"
        )
    width, contacts = padded(nv), rows // 3 + 1  # an elliptic contact has 3 rows or more
    widths = {"inertia": width * width, "factor": width * width, "squared": rows * stride, "cones": CONE * contacts}
    widths |= dict.fromkeys(("leaning", "first", "end"), contacts)
    widths |= dict.fromkeys(("pivot", "acc", "inertial", "push", "gradient", "direction", "moved"), width)
    kind: Any = Scratch
    scratch = kind()
    for name, field in kind.vars.items():
        setattr(scratch, name, wp.zeros((worlds, widths.get(name, rows)), dtype=field.type.dtype))
    return scratch
