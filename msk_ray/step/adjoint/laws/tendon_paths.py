"""Paths of spatial tendons: how the rates of a tendon's length turn with q.

A tendon's rate under a plain field x is ρ(x) = J x, and a spatial tendon's J turns with q:

    ρ(x) = n·(u₂(x) - u₁(x)) ,  n = (p₂ - p₁)/|p₂ - p₁| ,  u the velocities of the segment's ends under x.

On a wrapping geom the ends are tangent points that move over the surface; the rate sees them fixed to the geom's body
(the length is stationary in them), its own change sees them move.

The length itself changes with the path's sites alone by dl = n·dp along the straight pieces, and with a geom that moves
by (n₀ - n₁)·dp, n₀ and n₁ the directions towards and away from it.
"""

from functools import cache
from typing import Any

import warp as wp

from msk_ray.step.adjoint.groups import FieldBars, Fields, GeomGradients, Motion, Substep, TendonBars
from msk_ray.step.adjoint.laws.inside_wrap import inside_potential
from msk_ray.step.adjoint.laws.wrapping import PathPoses, Paths, touch_paths
from msk_ray.step.adjoint.spatial import carried, point_velocity, quat_gradient, turning_torque, wrench
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import MJ_MAXVAL, WrapType, wrap

wp.set_module_options({"enable_backward": False})


@wp.func
def wrap_potential(
    start: wp.vec3,
    end: wp.vec3,
    pos: wp.vec3,
    mat: wp.mat33,
    radius: wp.float32,
    kind: wp.int32,
    side: wp.vec3,
    weight0: wp.vec3,
    weight1: wp.vec3,
) -> wp.float32:
    """⟨weights, tangent points⟩ of a path from `start` to `end` around a sphere or cylinder."""
    _length, point0, point1 = wrap(start, end, pos, mat, radius, kind, side)
    return wp.dot(weight0, point0) + wp.dot(weight1, point1)


@wp.struct
class Rates:
    """Cotangents of one tendon's rates, times its pulley's share."""

    lam: float
    qacc: float
    qvel: float
    mu: float
    smooth: float


@wp.struct
class Twists:
    """Plain fields of one body."""

    lam: wp.spatial_vectorf
    qacc: wp.spatial_vectorf
    qvel: wp.spatial_vectorf
    mu: wp.spatial_vectorf
    smooth: wp.spatial_vectorf


@wp.func
def rates_of(worldid: int, t: int, share: float, tendon_bars_in: TendonBars) -> Rates:
    """Cotangents of a tendon's rates on a stretch of path that has this share of its length."""
    out = Rates()
    out.lam = share * tendon_bars_in.lam[worldid, t]
    out.qacc = share * tendon_bars_in.qacc[worldid, t]
    out.qvel = share * tendon_bars_in.qvel[worldid, t]
    out.mu = share * tendon_bars_in.mu[worldid, t]
    out.smooth = share * tendon_bars_in.smooth[worldid, t]
    return out


@wp.func
def weigh(rates: Rates, fields: Twists) -> wp.spatial_vectorf:
    """Σ_x ρ̄(x) V(x): one field that carries all that a direction's cotangent needs."""
    out = rates.lam * fields.lam + rates.qacc * fields.qacc + rates.qvel * fields.qvel
    return out + rates.mu * fields.mu + rates.smooth * fields.smooth


@wp.func
def segment_turn(start: wp.vec3, end: wp.vec3, slide: wp.vec3) -> wp.vec3:
    """Cotangent of the segment's end (minus that of its start): n̄ = Σ ρ̄ Δu ,  dn = (1 - n nᵀ) dp / |p|.

    Zero for a segment without length, which has no direction that could turn.
    """
    dif = end - start
    length = wp.length(dif)
    if length == 0.0:
        return wp.vec3(0.0)
    n = dif / length
    return (slide - n * wp.dot(n, slide)) / length


@wp.func
def end_place(direction: wp.vec3, turn: wp.vec3, total: wp.spatial_vectorf) -> wp.vec3:
    """Cotangent of one end's place: the segment turns, and the end's velocity changes as ω × dp."""
    return turn + wp.cross(direction, wp.spatial_top(total))


@wp.func
def end_wrench(arm: wp.vec3, direction: wp.vec3, place_bar: wp.vec3, total: wp.spatial_vectorf) -> wp.spatial_vectorf:
    """What one end of a segment pulls back to its own body's displacement."""
    zero = wp.vec3(0.0)
    return carried(total, wrench(direction, zero, arm)) + wrench(place_bar, zero, arm)


@wp.func
def push_body(
    body: int,
    worldid: int,
    along: wp.spatial_vectorf,
    moved: wp.spatial_vectorf,
    rates: Rates,
    bars_out: FieldBars,
) -> None:
    """Adds what a segment gives one of its bodies: rates ρ̄(x) along a wrench, and the cotangent of its displacement.

    What all tendons have as zero is left out, because atomic additions take most of the time.
    """
    if body > 0:
        if rates.lam != 0.0:
            wp.atomic_add(bars_out.lam, worldid, body, rates.lam * along)
        # â = a - (a - â): its cotangent goes to both fields
        if rates.qacc != 0.0 or rates.smooth != 0.0:
            wp.atomic_add(bars_out.qacc, worldid, body, (rates.qacc + rates.smooth) * along)
        if rates.qvel != 0.0:
            wp.atomic_add(bars_out.qvel, worldid, body, rates.qvel * along)
        if rates.mu != 0.0 or rates.smooth != 0.0:
            wp.atomic_add(bars_out.mu, worldid, body, rates.mu * along)
            wp.atomic_add(bars_out.excess, worldid, body, -rates.smooth * along)
        wp.atomic_add(bars_out.moved, worldid, body, moved)


@wp.func
def fields_of(
    body: int,
    worldid: int,
    rates: Rates,
    fields_in: Fields,
    cvel_in: wp.array2d[wp.spatial_vector],
) -> Twists:
    """Those fields of one body that the rates are not zero for."""
    out = Twists()
    out.lam = fields_in.lam[worldid, body]
    out.qvel = cvel_in[worldid, body]
    if rates.qacc != 0.0 or rates.smooth != 0.0:
        out.qacc = fields_in.qacc[worldid, body]
        out.smooth = out.qacc - fields_in.excess[worldid, body]
    if rates.mu != 0.0:
        out.mu = fields_in.mu[worldid, body]
    return out


@wp.struct
class SiteGradients:
    """Gradients by site, (W, S)."""

    site_pos: wp.array2d[wp.vec3]


@wp.func
def sub_point(
    worldid: int, item: int, body: int, bar: wp.vec3, xmat_in: wp.array2d[wp.mat33], out: wp.array2d[wp.vec3]
) -> None:
    """θ̄ -= ∂Φ/∂θ of a place in a body's frame, from its slope in the world's."""
    wp.atomic_sub(out, worldid, item, wp.transpose(xmat_in[worldid, body]) @ bar)


@wp.func
def length_by_radius(
    kind: int,
    mat: wp.mat33,
    pos: wp.vec3,
    touch0: wp.vec3,
    touch1: wp.vec3,
    radius: float,
    push: wp.vec3,
    inside: bool,
) -> float:
    """Slope of a path's length by the radius: ∫ of its curvature along the normal, or n₀ - n₁ there from inside."""
    arm0 = wp.transpose(mat) @ (touch0 - pos)
    arm1 = wp.transpose(mat) @ (touch1 - pos)
    if inside:  # the one point that touches moves outward with the surface
        if kind == WrapType.CYLINDER:
            arm0[2] = 0.0
        return wp.dot(mat @ wp.normalize(arm0), push)
    if kind == WrapType.SPHERE:
        return wp.atan2(wp.length(wp.cross(arm0, arm1)), wp.dot(arm0, arm1))
    rise = arm1[2] - arm0[2]
    angle = wp.atan2(wp.abs(arm0[0] * arm1[1] - arm0[1] * arm1[0]), arm0[0] * arm1[0] + arm0[1] * arm1[1])
    arc = radius * angle
    return angle * arc / wp.sqrt(arc * arc + rise * rise)


@cache
def pull_paths_kernel(keeps: bool) -> Any:
    """The kernel that also adds gradients of sites and geoms, or the one that pays nothing for them."""

    @wp.kernel(module="unique", enable_backward=False)
    def pull_paths(
        lanes: int,
        count: int,
        # Model:
        paths: Paths,
        geom_quat: wp.array2d[wp.quat],
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
        bars_out: FieldBars,
        sites_out: SiteGradients,
        geoms_out: GeomGradients,
    ) -> None:
        """How J x of a spatial tendon turns with q, and the gradients of its sites and of geoms that it wraps around.

        `lanes` threads take all `count` stretches of path of a world in turn: those between two sites, with or without
        a geom.
        """
        worldid, lane = wp.tid()
        for e in range(lane, count, lanes):
            t = paths.segment_tendon[e]
            first = paths.segment_first[e]
            site0 = paths.wrap_objid[first]
            site1 = paths.wrap_objid[paths.segment_last[e]]
            body0 = paths.site_bodyid[site0]
            body1 = paths.site_bodyid[site1]
            touch = touch_in[worldid, e]
            straight = touch[0] >= MJ_MAXVAL
            keeps_sites = bool(False)
            keeps_geoms = bool(False)
            if wp.static(keeps):
                keeps_sites = live_in[worldid] != 0 and sites_out.site_pos.shape[0] > 0
                keeps_geoms = live_in[worldid] != 0 and geoms_out.geom_pos.shape[0] > 0
            elif straight and body0 == body1:
                continue  # it turns with its body
            share = paths.wrap_pulley_scale[first]
            pull = share * tendon_bars_in.length[worldid, t]
            rates = rates_of(worldid, t, share, tendon_bars_in)
            total0 = weigh(rates, fields_of(body0, worldid, rates, fields_in, motion_in.cvel))
            total1 = weigh(rates, fields_of(body1, worldid, rates, fields_in, motion_in.cvel))
            start = poses_in.site_xpos[worldid, site0]
            end = poses_in.site_xpos[worldid, site1]
            com0 = motion_in.subtree_com[worldid, paths.body_rootid[body0]]
            com1 = motion_in.subtree_com[worldid, paths.body_rootid[body1]]
            zero = wp.vec3(0.0)
            start_bar = zero
            end_bar = zero
            if straight:
                n = wp.normalize(end - start)
                if body0 != body1:
                    slide = point_velocity(total1, end - com1) - point_velocity(total0, start - com0)
                    turn = segment_turn(start, end, slide)
                    start_bar = end_place(-n, -turn, total0)
                    end_bar = end_place(n, turn, total1)
                    moved0 = end_wrench(start - com0, -n, start_bar, total0)
                    moved1 = end_wrench(end - com1, n, end_bar, total1)
                    push_body(body0, worldid, wrench(-n, zero, start - com0), moved0, rates, bars_out)
                    push_body(body1, worldid, wrench(n, zero, end - com1), moved1, rates, bars_out)
                if keeps_sites:
                    sub_point(worldid, site0, body0, start_bar - pull * n, xmat_in, sites_out.site_pos)
                    sub_point(worldid, site1, body1, end_bar + pull * n, xmat_in, sites_out.site_pos)
                continue

            place = paths.segment_geom[e]
            geom = paths.wrap_objid[place]
            kind = paths.wrap_type[place]
            radius = paths.geom_size[worldid % paths.geom_size.shape[0], geom][0]
            sidesite = int(wp.round(paths.wrap_prm[place]))
            side = wp.vec3(MJ_MAXVAL)
            if sidesite >= 0:
                side = poses_in.site_xpos[worldid, sidesite]
            touch0 = wp.spatial_top(touch)
            touch1 = wp.spatial_bottom(touch)
            body = paths.geom_bodyid[geom]
            com = motion_in.subtree_com[worldid, paths.body_rootid[body]]
            total = weigh(rates, fields_of(body, worldid, rates, fields_in, motion_in.cvel))
            n0 = wp.normalize(touch0 - start)
            n1 = wp.normalize(end - touch1)
            along0 = wp.spatial_vectorf()
            along1 = wp.spatial_vectorf()
            along = wp.spatial_vectorf()
            moved0 = wp.spatial_vectorf()
            moved1 = wp.spatial_vectorf()
            moved = wp.spatial_vectorf()
            touch0_bar = zero
            touch1_bar = zero
            if body0 != body:
                slide = point_velocity(total, touch0 - com) - point_velocity(total0, start - com0)
                turn = segment_turn(start, touch0, slide)
                start_bar = end_place(-n0, -turn, total0)
                along0 = wrench(-n0, zero, start - com0)
                moved0 = end_wrench(start - com0, -n0, start_bar, total0)
                # The tangent point's displacement is not the geom's: its cotangent goes through the wrap below.
                touch0_bar = end_place(n0, turn, total)
                along += wrench(n0, zero, touch0 - com)
                moved += end_wrench(touch0 - com, n0, zero, total)
            if body1 != body:
                slide = point_velocity(total1, end - com1) - point_velocity(total, touch1 - com)
                turn = segment_turn(touch1, end, slide)
                end_bar = end_place(n1, turn, total1)
                along1 = wrench(n1, zero, end - com1)
                moved1 = end_wrench(end - com1, n1, end_bar, total1)
                touch1_bar = end_place(-n1, -turn, total)
                along += wrench(-n1, zero, touch1 - com)
                moved += end_wrench(touch1 - com, -n1, zero, total)
            mat = poses_in.geom_xmat[worldid, geom]
            pos = poses_in.geom_xpos[worldid, geom]
            from_start = zero
            from_end = zero
            pos_bar = zero
            mat_bar = wp.mat33(0.0)
            side_bar = zero
            radius_bar = float(0.0)
            spot = inside_in[worldid, e]
            inside = spot[3] != 0.0
            if inside:
                from_start, from_end, pos_bar, mat_bar, radius_bar, _k, _p, _w = wp.grad(inside_potential)(
                    start, end, pos, mat, radius, kind, wp.vec3(spot[0], spot[1], spot[2]), touch0_bar + touch1_bar
                )
            else:
                from_start, from_end, pos_bar, mat_bar, radius_bar, _k, side_bar, _w0, _w1 = wp.grad(wrap_potential)(
                    start, end, pos, mat, radius, kind, side, touch0_bar, touch1_bar
                )
            torque = turning_torque(mat, mat_bar)
            push_body(body0, worldid, along0, moved0 + wrench(from_start, zero, start - com0), rates, bars_out)
            push_body(body1, worldid, along1, moved1 + wrench(from_end, zero, end - com1), rates, bars_out)
            push_body(body, worldid, along, moved + wrench(pos_bar, torque, pos - com), rates, bars_out)
            if sidesite >= 0:
                owner = paths.site_bodyid[sidesite]
                if owner > 0:
                    arm = side - motion_in.subtree_com[worldid, paths.body_rootid[owner]]
                    wp.atomic_add(bars_out.moved, worldid, owner, wrench(side_bar, zero, arm))
                if keeps_sites:
                    sub_point(worldid, sidesite, owner, side_bar, xmat_in, sites_out.site_pos)
            if keeps_sites:
                sub_point(worldid, site0, body0, start_bar - pull * n0 + from_start, xmat_in, sites_out.site_pos)
                sub_point(worldid, site1, body1, end_bar + pull * n1 + from_end, xmat_in, sites_out.site_pos)
            if keeps_geoms:
                radius_bar += pull * length_by_radius(kind, mat, pos, touch0, touch1, radius, n0 - n1, inside)
                sub_point(worldid, geom, body, pull * (n0 - n1) + pos_bar, xmat_in, geoms_out.geom_pos)
                torque += pull * (wp.cross(touch0 - pos, n0) - wp.cross(touch1 - pos, n1))
                quat = geom_quat[worldid % geom_quat.shape[0], geom]
                wp.atomic_sub(geoms_out.geom_quat, worldid, geom, quat_gradient(quat, wp.transpose(mat) @ torque))
                wp.atomic_sub(geoms_out.geom_size, worldid, geom, wp.vec3(radius_bar, 0.0, 0.0))

    return pull_paths


class TendonPaths:
    """Launches of the tangent points on wrapping geoms, and of what paths give ∂Φ.

    Attributes:
        touch, inside: as `touch_paths` leaves them, (W, segments).
    """

    def __init__(self, work: Workspace) -> None:
        self._work = work
        shape = (work.nworld, work.tables.segment_tendon.size)
        self.touch = wp.full(shape, wp.spatial_vector(*([MJ_MAXVAL] * 6)), dtype=wp.spatial_vector)
        self.inside = wp.zeros(shape, dtype=wp.vec4)

    def launch(self, at: Substep) -> None:
        """Launch both."""
        work = self._work
        points = {"touch": self.touch, "inside": self.inside}
        if work.tables.has_wrapping:
            work.launch(touch_paths, self.touch.shape, at, **points)
        kernel = pull_paths_kernel(at.wants(SiteGradients, GeomGradients))
        gradients = (at.gradient(SiteGradients), at.gradient(GeomGradients))
        work.launch_lanes(kernel, self.touch.shape[1], at, *gradients, **points)
