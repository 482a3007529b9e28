"""Sites on the paths of tendons, and the geoms that paths wrap around.

A path's length is stationary in its tangent points, so it changes with its sites alone by dl = n·dp along the straight
pieces, and with a geom that moves by (n₀ - n₁)·dp, n₀ and n₁ the directions towards and away from it. Its rates turn
with the pieces as in `adjoint.paths`, where the tangent points move with sites and geom.
"""

from typing import Any

import warp as wp

from msk_ray.step.adjoint.groups import Fields, Motion, Substep, TendonBars
from msk_ray.step.adjoint.laws.inside_wrap import inside_score
from msk_ray.step.adjoint.laws.tendon_paths import Rates, Twists, fields_of, rates_of, segment_turn, weigh, wrap_score
from msk_ray.step.adjoint.laws.wrapping import PathPoses, Paths
from msk_ray.step.adjoint.parameters.base import ParameterStage, Parts, quat_gradient
from msk_ray.step.adjoint.parameters.geoms import GeomGradients
from msk_ray.step.adjoint.spatial import point_velocity, turning_torque
from msk_ray.step.forward.mjw_private import MJ_MAXVAL, WrapType

wp.set_module_options({"enable_backward": False})


@wp.struct
class SiteGradients:
    """Gradients by site, (W, S)."""

    site_pos: wp.array2d[wp.vec3]


@wp.struct
class WrapQuats:
    """Orientations of geoms in their bodies."""

    geom_quat: wp.array2d[wp.quat]


@wp.func
def sub_point(
    worldid: int, item: int, body: int, bar: wp.vec3, xmat_in: wp.array2d[wp.mat33], out: wp.array2d[wp.vec3]
) -> None:
    """θ̄ -= ∂Φ/∂θ of a place in a body's frame, from its slope in the world's."""
    wp.atomic_sub(out, worldid, item, wp.transpose(xmat_in[worldid, body]) @ bar)


@wp.func
def end_bar(n: wp.vec3, turn: wp.vec3, rates: Rates, fields: Twists, length_bar: float) -> wp.vec3:
    """Slope of Φ along the end of a piece of direction n towards it, fixed to a body with these fields."""
    return length_bar * n + turn + wp.cross(n, wp.spatial_top(weigh(rates, fields)))


@wp.func
def turn_of_length(kind: int, mat: wp.mat33, pos: wp.vec3, touch0: wp.vec3, touch1: wp.vec3, radius: float) -> float:
    """Slope of an arc's length by the radius: ∫ of its curvature along the normal."""
    arm0 = wp.transpose(mat) @ (touch0 - pos)
    arm1 = wp.transpose(mat) @ (touch1 - pos)
    if kind == WrapType.SPHERE:
        return wp.atan2(wp.length(wp.cross(arm0, arm1)), wp.dot(arm0, arm1))
    rise = arm1[2] - arm0[2]
    angle = wp.atan2(wp.abs(arm0[0] * arm1[1] - arm0[1] * arm1[0]), arm0[0] * arm1[0] + arm0[1] * arm1[1])
    arc = radius * angle
    return angle * arc / wp.sqrt(arc * arc + rise * rise)


@wp.kernel
def pull_path_parameters(
    # Model:
    paths: Paths,
    quats: WrapQuats,
    # In:
    live_in: wp.array[int],
    touch_in: wp.array2d[wp.spatial_vector],
    inside_in: wp.array2d[wp.vec4],
    poses_in: PathPoses,
    xmat_in: wp.array2d[wp.mat33],
    motion_in: Motion,
    fields_in: Fields,
    tendon_bars_in: TendonBars,
    # Out:
    sites_out: SiteGradients,
    geoms_out: GeomGradients,
) -> None:
    """Gradients of the sites of one stretch of path, and of the geom it wraps around."""
    worldid, e = wp.tid()
    if live_in[worldid] == 0:
        return
    t = paths.segment_tendon[e]
    first = paths.segment_first[e]
    share = paths.wrap_pulley_scale[first]
    pull = share * tendon_bars_in.length[worldid, t]
    rates = rates_of(worldid, t, share, tendon_bars_in)
    site0 = paths.wrap_objid[first]
    site1 = paths.wrap_objid[paths.segment_last[e]]
    body0 = paths.site_bodyid[site0]
    body1 = paths.site_bodyid[site1]
    start = poses_in.site_xpos[worldid, site0]
    end = poses_in.site_xpos[worldid, site1]
    com0 = motion_in.subtree_com[worldid, paths.body_rootid[body0]]
    com1 = motion_in.subtree_com[worldid, paths.body_rootid[body1]]
    f0 = fields_of(body0, worldid, rates, fields_in, motion_in.cvel)
    f1 = fields_of(body1, worldid, rates, fields_in, motion_in.cvel)
    if touch_in[worldid, e][0] >= MJ_MAXVAL:
        n = wp.normalize(end - start)
        slide = point_velocity(weigh(rates, f1), end - com1) - point_velocity(weigh(rates, f0), start - com0)
        turn = segment_turn(start, end, slide)
        if body0 == body1:
            # Both ends move alike: the piece has a length, but no rate.
            sub_point(worldid, site0, body0, -pull * n, xmat_in, sites_out.site_pos)
            sub_point(worldid, site1, body1, pull * n, xmat_in, sites_out.site_pos)
            return
        sub_point(worldid, site0, body0, end_bar(-n, -turn, rates, f0, pull), xmat_in, sites_out.site_pos)
        sub_point(worldid, site1, body1, end_bar(n, turn, rates, f1, pull), xmat_in, sites_out.site_pos)
        return

    place = paths.segment_geom[e]
    geom = paths.wrap_objid[place]
    kind = paths.wrap_type[place]
    radius = paths.geom_size[worldid % paths.geom_size.shape[0], geom][0]
    body = paths.geom_bodyid[geom]
    com = motion_in.subtree_com[worldid, paths.body_rootid[body]]
    pos = poses_in.geom_xpos[worldid, geom]
    mat = poses_in.geom_xmat[worldid, geom]
    total = weigh(rates, fields_of(body, worldid, rates, fields_in, motion_in.cvel))
    touch0 = wp.spatial_top(touch_in[worldid, e])
    touch1 = wp.spatial_bottom(touch_in[worldid, e])
    n0 = wp.normalize(touch0 - start)
    n1 = wp.normalize(end - touch1)
    start_bar = -pull * n0
    last_bar = pull * n1
    touch0_bar = wp.vec3(0.0)
    touch1_bar = wp.vec3(0.0)
    if body0 != body:
        slide = point_velocity(total, touch0 - com) - point_velocity(weigh(rates, f0), start - com0)
        turn = segment_turn(start, touch0, slide)
        start_bar = end_bar(-n0, -turn, rates, f0, pull)
        touch0_bar = turn + wp.cross(n0, wp.spatial_top(total))
    if body1 != body:
        slide = point_velocity(weigh(rates, f1), end - com1) - point_velocity(total, touch1 - com)
        turn = segment_turn(touch1, end, slide)
        last_bar = end_bar(n1, turn, rates, f1, pull)
        touch1_bar = -turn - wp.cross(n1, wp.spatial_top(total))
    side = wp.vec3(MJ_MAXVAL)
    sidesite = int(wp.round(paths.wrap_prm[place]))
    if sidesite >= 0:
        side = poses_in.site_xpos[worldid, sidesite]
    spot = inside_in[worldid, e]
    from_start = wp.vec3(0.0)
    from_end = wp.vec3(0.0)
    from_pos = wp.vec3(0.0)
    from_mat = wp.mat33(0.0)
    from_side = wp.vec3(0.0)
    radius_bar = float(0.0)
    if spot[3] != 0.0:
        from_start, from_end, from_pos, from_mat, radius_bar, _k, _p, _w = wp.grad(inside_score)(
            start, end, pos, mat, radius, kind, wp.vec3(spot[0], spot[1], spot[2]), touch0_bar + touch1_bar
        )
        # The one point that touches moves outward with the surface.
        arm = wp.transpose(mat) @ (touch0 - pos)
        if kind == WrapType.CYLINDER:
            arm[2] = 0.0
        radius_bar += pull * wp.dot(mat @ wp.normalize(arm), n0 - n1)
    else:
        from_start, from_end, from_pos, from_mat, radius_bar, _k, from_side, _w0, _w1 = wp.grad(wrap_score)(
            start, end, pos, mat, radius, kind, side, touch0_bar, touch1_bar
        )
        radius_bar += pull * turn_of_length(kind, mat, pos, touch0, touch1, radius)
    sub_point(worldid, site0, body0, start_bar + from_start, xmat_in, sites_out.site_pos)
    sub_point(worldid, site1, body1, last_bar + from_end, xmat_in, sites_out.site_pos)
    if sidesite >= 0:
        sub_point(worldid, sidesite, paths.site_bodyid[sidesite], from_side, xmat_in, sites_out.site_pos)
    sub_point(worldid, geom, body, pull * (n0 - n1) + from_pos, xmat_in, geoms_out.geom_pos)
    torque = turning_torque(mat, from_mat) + pull * (wp.cross(touch0 - pos, n0) - wp.cross(touch1 - pos, n1))
    quat = quats.geom_quat[worldid % quats.geom_quat.shape[0], geom]
    wp.atomic_sub(geoms_out.geom_quat, worldid, geom, quat_gradient(quat, wp.transpose(mat) @ torque))
    wp.atomic_sub(geoms_out.geom_size, worldid, geom, wp.vec3(radius_bar, 0.0, 0.0))


class PathStage(ParameterStage):
    """Launches of the gradients of sites and wrapping geoms on the paths of tendons."""

    kinds = (SiteGradients, GeomGradients)

    def __init__(self, parts: Parts, gradients: dict[Any, Any]) -> None:
        super().__init__(parts, gradients)
        assert parts.tendons is not None
        assert parts.tendons.paths is not None
        self._paths = parts.tendons.paths

    @classmethod
    def applies(cls, parts: Parts) -> bool:
        return parts.tendons is not None and parts.tendons.paths is not None

    def launch(self, at: Substep) -> None:
        paths = self._paths
        self.work.launch(
            pull_path_parameters, paths.touch.shape, at, *self.gradients, touch=paths.touch, inside=paths.inside
        )
