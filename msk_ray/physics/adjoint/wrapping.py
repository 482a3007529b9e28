"""Tangent points of tendon paths on wrapping geoms.

Kept apart from `tendons`: Warp drops the derivative of a function that another kernel of the module runs forward only.
"""

import warp as wp

from msk_ray.physics.mjw_private import MJ_MAXVAL, wrap

wp.set_module_options({"enable_backward": False})

_LEAST_ARC = wp.constant(1.0e-6)
"""Arcs up to this long count as a straight path [m]."""


@wp.kernel
def touch_paths(
    # Model:
    geom_size: wp.array2d[wp.vec3],
    wrap_type: wp.array[int],
    wrap_objid: wp.array[int],
    wrap_prm: wp.array[float],
    segment_first: wp.array[int],
    segment_geom: wp.array[int],
    segment_last: wp.array[int],
    # In:
    geom_xpos_in: wp.array2d[wp.vec3],
    geom_xmat_in: wp.array2d[wp.mat33],
    site_xpos_in: wp.array2d[wp.vec3],
    # Out:
    touch_out: wp.array2d[wp.spatial_vector],
) -> None:
    """Both tangent points of each stretch of path, MJ_MAXVAL where it runs straight."""
    worldid, e = wp.tid()
    far = wp.vec3(MJ_MAXVAL)
    touch_out[worldid, e] = wp.spatial_vector(far, far)
    place = segment_geom[e]
    if place < 0:
        return
    geom = wrap_objid[place]
    side = far
    sidesite = int(wp.round(wrap_prm[place]))
    if sidesite >= 0:
        side = site_xpos_in[worldid, sidesite]
    arc, point0, point1 = wrap(
        site_xpos_in[worldid, wrap_objid[segment_first[e]]],
        site_xpos_in[worldid, wrap_objid[segment_last[e]]],
        geom_xpos_in[worldid, geom],
        geom_xmat_in[worldid, geom],
        geom_size[worldid % geom_size.shape[0], geom][0],
        wrap_type[place],
        side,
    )
    # A path that only just touches has the rates of a straight one; its arc's length, a square root, has no slope.
    if arc > _LEAST_ARC:
        touch_out[worldid, e] = wp.spatial_vector(point0, point1)
