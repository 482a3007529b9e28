"""Tangent points of tendon paths on wrapping geoms.

In a module of its own, because it calls forward what `tendon_paths` differentiates (CONTRIBUTING, "a new law").
"""

import warp as wp

from msk_ray.step.adjoint.laws.inside_wrap import inside_place
from msk_ray.step.forward.mjw_private import MJ_MAXVAL, wrap

wp.set_module_options({"enable_backward": False})

_LEAST_ARC = wp.constant(1.0e-6)
"""Arcs up to this long count as a straight path [m]."""


@wp.struct
class Paths:
    """Stretches of tendon paths, and the sites and geoms they run over."""

    body_rootid: wp.array[int]
    geom_bodyid: wp.array[int]
    geom_size: wp.array2d[wp.vec3]
    site_bodyid: wp.array[int]
    wrap_type: wp.array[int]
    wrap_objid: wp.array[int]
    wrap_prm: wp.array[float]
    wrap_pulley_scale: wp.array[float]
    segment_tendon: wp.array[int]
    segment_first: wp.array[int]
    segment_geom: wp.array[int]
    segment_last: wp.array[int]


@wp.struct
class PathPoses:
    """Poses of geoms and sites."""

    geom_xpos: wp.array2d[wp.vec3]
    geom_xmat: wp.array2d[wp.mat33]
    site_xpos: wp.array2d[wp.vec3]


@wp.kernel
def touch_paths(
    # Model:
    paths: Paths,
    # In:
    poses_in: PathPoses,
    # Out:
    touch_out: wp.array2d[wp.spatial_vector],
    inside_out: wp.array2d[wp.vec4],
) -> None:
    """Both tangent points of each stretch of path, MJ_MAXVAL where it runs straight.

    For a path inside its geom, also `inside_place` and a one; zeros for others.
    """
    worldid, e = wp.tid()
    far = wp.vec3(MJ_MAXVAL)
    touch_out[worldid, e] = wp.spatial_vector(far, far)
    inside_out[worldid, e] = wp.vec4(0.0)
    place = paths.segment_geom[e]
    if place < 0:
        return
    geom = paths.wrap_objid[place]
    side = far
    sidesite = int(wp.round(paths.wrap_prm[place]))
    if sidesite >= 0:
        side = poses_in.site_xpos[worldid, sidesite]
    start = poses_in.site_xpos[worldid, paths.wrap_objid[paths.segment_first[e]]]
    end = poses_in.site_xpos[worldid, paths.wrap_objid[paths.segment_last[e]]]
    pos = poses_in.geom_xpos[worldid, geom]
    mat = poses_in.geom_xmat[worldid, geom]
    radius = paths.geom_size[worldid % paths.geom_size.shape[0], geom][0]
    kind = paths.wrap_type[place]
    arc, point0, point1 = wrap(start, end, pos, mat, radius, kind, side)
    if sidesite >= 0 and wp.length(wp.transpose(mat) @ (side - pos)) < radius:
        # Inside a geom both points are the same, and there is no arc.
        if arc >= 0.0:
            touch_out[worldid, e] = wp.spatial_vector(point0, point1)
            spot = inside_place(start, end, pos, mat, radius, kind, point0)
            inside_out[worldid, e] = wp.vec4(spot[0], spot[1], spot[2], 1.0)
        return
    # A path that only just touches has the rates of a straight one; its arc's length, a square root, has no slope.
    if arc > _LEAST_ARC:
        touch_out[worldid, e] = wp.spatial_vector(point0, point1)
