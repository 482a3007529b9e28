"""Impedance, stiffness and damping of a constraint row, as functions of its solver parameters and its position.

    aref = -b ρ(v) - k imp(pos) pos ,    D = imp / ((1 - imp) w)
    imp = dmin + y(|pos| / width) (dmax - dmin) ,  y a power curve from 0 to 1 through (mid, mid)

They are mujoco_warp's, except where dmin = dmax: there its function takes another branch, which has other slopes by
dmin and dmax. `row_slopes` differentiates them by position, the potentials in `parameters` by everything else too.
"""

import warp as wp
from mujoco_warp import DisableBit

from msk_ray.step.forward.mjw_private import vec5

wp.set_module_options({"enable_backward": False})

_MINVAL = wp.constant(1.0e-15)
_MINIMP = wp.constant(1.0e-4)
_MAXIMP = wp.constant(0.9999)


@wp.func
def impedance(solimp: vec5, pos: wp.float32) -> wp.float32:
    """imp."""
    low = wp.clamp(solimp[0], _MINIMP, _MAXIMP)
    high = wp.clamp(solimp[1], _MINIMP, _MAXIMP)
    mid = wp.clamp(solimp[3], _MINIMP, _MAXIMP)
    power = wp.max(1.0, solimp[4])
    share = wp.float32(0.5)
    if solimp[2] > _MINVAL:
        x = wp.abs(pos) / solimp[2]
        if x <= 0.0:
            share = wp.float32(0.0)
        elif x >= 1.0:
            share = wp.float32(1.0)
        elif power == 1.0:
            share = x
        elif x <= mid:
            share = wp.pow(x, power) / wp.pow(mid, power - 1.0)
        else:
            share = 1.0 - wp.pow(1.0 - x, power) / wp.pow(1.0 - mid, power - 1.0)
    return low + share * (high - low)


@wp.func
def stiffness_damping(disableflags: wp.int32, timestep: wp.float32, solref: wp.vec2, dmax: wp.float32) -> wp.vec2:
    """(k, b)."""
    high = wp.clamp(dmax, _MINIMP, _MAXIMP)
    timeconst = solref[0]
    if not (disableflags & DisableBit.REFSAFE):
        timeconst = wp.max(timeconst, 2.0 * timestep)
    k = wp.float32(0.0)
    b = wp.float32(0.0)
    if solref[0] <= 0.0:
        k = -solref[0] / (high * high)
    else:
        k = 1.0 / wp.max(_MINVAL, high * high * timeconst * timeconst * solref[1] * solref[1])
    if solref[1] <= 0.0:
        b = -solref[1] / high
    else:
        b = 2.0 / wp.max(_MINVAL, high * timeconst)
    return wp.vec2(k, b)


@wp.struct
class RowSlopes:
    """How aref and D of one row answer to its velocity and position."""

    damping: float
    """b = -∂aref/∂ρ(v) [1/s]."""
    spring: float
    """k imp [1/s²]."""
    stiffness: float
    """-∂aref/∂pos, with the slope of imp [1/s²]."""
    mass: float
    """d(log D)/d(pos) = imp' / (imp (1 - imp)) [1/m]."""


@wp.func
def row_slopes(disableflags: int, timestep: float, solref: wp.vec2, solimp: vec5, pos: float) -> RowSlopes:
    """Slopes of one row."""
    kb = stiffness_damping(disableflags, timestep, solref, solimp[1])
    imp = impedance(solimp, pos)
    _solimp, slope = wp.grad(impedance)(solimp, pos)
    out = RowSlopes()
    out.damping = kb[1]
    out.spring = kb[0] * imp
    out.stiffness = kb[0] * (imp + slope * pos)
    out.mass = slope / (imp * (1.0 - imp))
    return out
