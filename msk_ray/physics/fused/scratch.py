"""What the threads of the solver keep between their loops, in memory that is allocated once."""

from typing import Any

import numpy as np
import warp as wp

from msk_ray.errors import ConfigError
from msk_ray.physics.fused.memory import MOST_ELEMENTS

WORLD_FASTEST = True
"""Whether the numbers of neighbouring worlds are side by side, so that the threads of a warp, which read the same four
numbers of 32 worlds at once, read whole lines of memory. False: those of one world are."""
CONE = wp.constant(3)
"""Times four numbers that the line search keeps of each elliptic contact."""


@wp.struct
class Scratch:
    """For W worlds of R rows, C elliptic contacts and B blocks of 4 degrees of freedom. Every array is (W, ...).

    The rows of elliptic contacts come first, those of one contact together; all other rows are at the end, the first
    of them last. The worlds of one launch then have rows of one kind at the same places, wherever their counts differ.
    """

    inertia: wp.array2d[wp.vec4]
    """M, symmetric, 4 B²; the identity where it is padded."""
    factor: wp.array2d[wp.vec4]
    """Cholesky factor of the Hessian, 4 B², with the reciprocals of its diagonal."""
    rows: wp.array2d[wp.vec4]
    """J, R B; behind it what takes the place of an elliptic contact's rows in the Hessian, R B."""
    springs: wp.array2d[wp.vec4]
    """Of each row D, its bound, J a - aref, and J times the direction, R. The bound is the frictionloss of a dof or
    tendon; of an elliptic contact it is μ in the first row, and the coefficients of friction in the others."""
    force: wp.array2d[float]
    """R."""
    weight: wp.array2d[float]
    """Weight of each row in the Hessian, R."""
    cones: wp.array2d[wp.vec4]
    """What the line search knows of each elliptic contact, 3 C."""
    first: wp.array2d[int]
    """First row of each elliptic contact, and behind the last one the end, C + 1."""
    source: wp.array2d[int]
    """Number of each row in mujoco_warp's arrays, R."""
    state: wp.array2d[int]
    """ConstraintState of each row, R."""
    acc: wp.array2d[wp.vec4]
    """Acceleration a, B."""
    inertial: wp.array2d[wp.vec4]
    """M a, B."""
    smooth: wp.array2d[wp.vec4]
    """Smooth force τ, B."""
    push: wp.array2d[wp.vec4]
    """Jᵀ f, B."""
    gradient: wp.array2d[wp.vec4]
    """M a - τ - Jᵀ f, B."""
    direction: wp.array2d[wp.vec4]
    """Newton's direction, B."""
    moved: wp.array2d[wp.vec4]
    """M times the direction, B."""


def blocks_of(nv: int) -> int:
    """Blocks of 4 degrees of freedom."""
    return -(-nv // 4)


def make_scratch(worlds: int, rows: int, nv: int) -> Any:
    """Arrays for as many worlds, rows a world and degrees of freedom, on the current device.

    Raises:
        ConfigError: they would be too large to be counted in 32 bits.
    """
    blocks, contacts = blocks_of(nv), rows // 3 + 1  # an elliptic contact has 3 rows or more
    widths = {"inertia": 4 * blocks * blocks, "factor": 4 * blocks * blocks, "rows": 2 * rows * blocks}
    widths |= {"cones": 3 * contacts, "first": contacts + 1}
    widths |= dict.fromkeys(("acc", "inertial", "smooth", "push", "gradient", "direction", "moved"), blocks)
    most = MOST_ELEMENTS // max(widths.values())
    if worlds > most:
        raise ConfigError(
            f"the fused solver has room for {most} worlds of {rows} constraint rows: take fewer worlds, or write "
            "physics.solver_kernels: mujoco_warp"
        )
    kind: Any = Scratch
    scratch = kind()
    for name, field in kind.vars.items():
        setattr(scratch, name, _zeros(worlds, widths.get(name, rows), field.type.dtype))
    padding = np.zeros((4 * blocks, 4 * blocks), np.float32)
    padding[range(nv, 4 * blocks), range(nv, 4 * blocks)] = 1.0
    scratch.inertia.assign(np.tile(padding.reshape(-1, 4), (worlds, 1, 1)))
    return scratch


def _zeros(worlds: int, count: int, dtype: type) -> wp.array:
    if WORLD_FASTEST:
        return wp.zeros((count, worlds), dtype=dtype).transpose()
    return wp.zeros((worlds, count), dtype=dtype)
