"""What the threads of the solver keep between their loops, in memory that is allocated once."""

from typing import Any

import numpy as np
import warp as wp

WORLD_FASTEST = True
"""Whether the numbers of neighbouring worlds are side by side, so that the threads of a warp, which read the same
number of 32 worlds at once, read one line of memory. False: those of one world are."""
CONE = wp.constant(10)
"""Numbers that the line search keeps of each sliding contact."""


@wp.struct
class Scratch:
    """For W worlds of R rows and `nv` degrees of freedom, rounded up to P. Every array is (W, ...).

    The rows of elliptic contacts come first, those of one contact together; all other rows are at the end, the first
    of them last. The worlds of one launch then have rows of one kind at the same places, wherever their counts differ.
    """

    inertia: wp.array2d[float]
    """M, symmetric, P²; the identity where it is padded."""
    factor: wp.array2d[float]
    """Cholesky factor of the Hessian, P², with the reciprocals of its diagonal."""
    rows: wp.array2d[float]
    """J, R P; behind it as many rows that take the place of a contact's in the Hessian while it slides."""
    stiffness: wp.array2d[float]
    """D of each row, R."""
    jar: wp.array2d[float]
    """J a - aref, R."""
    rate: wp.array2d[float]
    """J times the direction, R."""
    force: wp.array2d[float]
    """R."""
    weight: wp.array2d[float]
    """Weight of each row in the Hessian, 0 where it does not count, R."""
    bound: wp.array2d[float]
    """Frictionloss of a dof or tendon; μ of a contact's first row, and the friction coefficients of its others, R."""
    cones: wp.array2d[float]
    """What the line search knows of each elliptic contact."""
    first: wp.array2d[int]
    """First row of each elliptic contact, and behind the last one the end."""
    source: wp.array2d[int]
    """Number of each row in mujoco_warp's arrays, R."""
    state: wp.array2d[int]
    """ConstraintState of each row, R."""
    acc: wp.array2d[float]
    """Acceleration a, P."""
    inertial: wp.array2d[float]
    """M a, P."""
    smooth: wp.array2d[float]
    """Smooth force τ, P."""
    push: wp.array2d[float]
    """Jᵀ f, P."""
    gradient: wp.array2d[float]
    """M a - τ - Jᵀ f, P."""
    direction: wp.array2d[float]
    """Newton's direction, P."""
    moved: wp.array2d[float]
    """M times the direction, P."""


def padded(nv: int) -> int:
    """Degrees of freedom in whole blocks."""
    return -(-nv // 4) * 4


def make_scratch(worlds: int, rows: int, nv: int) -> Any:
    """Arrays for as many worlds, rows a world and degrees of freedom, on the current device."""
    width, contacts = padded(nv), rows // 3 + 1  # an elliptic contact has 3 rows or more
    widths = {"inertia": width * width, "factor": width * width, "rows": 2 * rows * width}
    widths |= {"cones": CONE * contacts, "first": contacts + 1}
    widths |= dict.fromkeys(("acc", "inertial", "smooth", "push", "gradient", "direction", "moved"), width)
    kind: Any = Scratch
    scratch = kind()
    for name, field in kind.vars.items():
        setattr(scratch, name, _zeros(worlds, widths.get(name, rows), field.type.dtype))
    identity = np.zeros((width, width), np.float32)
    identity[range(nv, width), range(nv, width)] = 1.0
    scratch.inertia.assign(np.tile(identity.ravel(), (worlds, 1)))
    return scratch


def _zeros(worlds: int, count: int, dtype: type) -> wp.array:
    if WORLD_FASTEST:
        return wp.zeros((count, worlds), dtype=dtype).transpose()
    return wp.zeros((worlds, count), dtype=dtype)
