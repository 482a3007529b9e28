"""Stiffness, damping and impedance of a constraint row, differentiable by all solver parameters.

As in mujoco_warp, whose function takes another branch where dmin = dmax and has other slopes there. Only for scores
that are differentiated: Warp drops the derivative of a function that a kernel of the module runs forward only.
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
    """dmin + y(|pos|/width) (dmax - dmin), y a power curve from 0 to 1 through (mid, mid)."""
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
    """(k, b) of aref = -b ρ(v) - k imp pos."""
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


@wp.func
def row_spring(disableflags: wp.int32, timestep: wp.float32, solref: wp.vec2, solimp: vec5, pos: wp.float32) -> wp.vec3:
    """(k, b, impedance) of a row."""
    kb = stiffness_damping(disableflags, timestep, solref, solimp[1])
    return wp.vec3(kb[0], kb[1], impedance(solimp, pos))
