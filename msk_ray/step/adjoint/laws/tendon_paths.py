"""Paths of spatial tendons: how the rates of a tendon's length turn with q.

A tendon's rate under a plain field x is ρ(x) = J x, and a spatial tendon's J turns with q:

    ρ(x) = n·(u₂(x) - u₁(x)) ,  n = (p₂ - p₁)/|p₂ - p₁| ,  u the velocities of the segment's ends under x.

On a wrapping geom the ends are tangent points that move over the surface; the rate sees them fixed to the geom's body
(the length is stationary in them), its own change sees them move.
"""

import warp as wp

from msk_ray.step.adjoint.groups import FieldBars, Fields, Motion, Substep, TendonBars
from msk_ray.step.adjoint.laws.inside_wrap import inside_score
from msk_ray.step.adjoint.laws.wrapping import PathPoses, Paths, touch_paths
from msk_ray.step.adjoint.spatial import carried, point_velocity, wrench
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import MJ_MAXVAL, wrap

wp.set_module_options({"enable_backward": False})


@wp.func
def wrap_score(
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
def end_wrench(arm: wp.vec3, direction: wp.vec3, turn: wp.vec3, rates: Rates, fields: Twists) -> wp.spatial_vectorf:
    """What one end of a segment pulls back to its own body's displacement.

    The velocity of the end changes with its place as ω × dp ⇒ p̄ ∋ direction × Σ ρ̄ ω.
    """
    zero = wp.vec3(0.0)
    total = weigh(rates, fields)
    place = turn + wp.cross(direction, wp.spatial_top(total))
    return carried(total, wrench(direction, zero, arm)) + wrench(place, zero, arm)


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


@wp.kernel
def pull_paths(
    lanes: int,
    count: int,
    # Model:
    paths: Paths,
    # In:
    touch_in: wp.array2d[wp.spatial_vector],
    inside_in: wp.array2d[wp.vec4],
    poses_in: PathPoses,
    motion_in: Motion,
    fields_in: Fields,
    tendon_bars_in: TendonBars,
    # Out:
    bars_out: FieldBars,
) -> None:
    """How J x of a spatial tendon turns with q.

    `lanes` threads take all `count` stretches of path of a world in turn: those between two sites, with or without a
    geom.
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
        if straight and body0 == body1:
            continue  # it turns with its body
        rates = rates_of(worldid, t, paths.wrap_pulley_scale[first], tendon_bars_in)
        f0 = fields_of(body0, worldid, rates, fields_in, motion_in.cvel)
        f1 = fields_of(body1, worldid, rates, fields_in, motion_in.cvel)
        start = poses_in.site_xpos[worldid, site0]
        end = poses_in.site_xpos[worldid, site1]
        com0 = motion_in.subtree_com[worldid, paths.body_rootid[body0]]
        com1 = motion_in.subtree_com[worldid, paths.body_rootid[body1]]

        place = paths.segment_geom[e]
        geom = int(0)
        kind = int(0)
        radius = float(0.0)
        side = wp.vec3(MJ_MAXVAL)
        if place >= 0:
            geom = paths.wrap_objid[place]
            kind = paths.wrap_type[place]
            radius = paths.geom_size[worldid % paths.geom_size.shape[0], geom][0]
            sidesite = int(wp.round(paths.wrap_prm[place]))
            if sidesite >= 0:
                side = poses_in.site_xpos[worldid, sidesite]
        zero = wp.vec3(0.0)
        if straight:
            n = wp.normalize(end - start)
            slide = point_velocity(weigh(rates, f1), end - com1) - point_velocity(weigh(rates, f0), start - com0)
            turn = segment_turn(start, end, slide)
            moved0 = end_wrench(start - com0, -n, -turn, rates, f0)
            moved1 = end_wrench(end - com1, n, turn, rates, f1)
            push_body(body0, worldid, wrench(-n, zero, start - com0), moved0, rates, bars_out)
            push_body(body1, worldid, wrench(n, zero, end - com1), moved1, rates, bars_out)
            continue

        touch0 = wp.spatial_top(touch)
        touch1 = wp.spatial_bottom(touch)
        body = paths.geom_bodyid[geom]
        com = motion_in.subtree_com[worldid, paths.body_rootid[body]]
        fg = fields_of(body, worldid, rates, fields_in, motion_in.cvel)
        total = weigh(rates, fg)
        spin = wp.spatial_top(total)
        along0 = wp.spatial_vectorf()
        along1 = wp.spatial_vectorf()
        along = wp.spatial_vectorf()
        moved0 = wp.spatial_vectorf()
        moved1 = wp.spatial_vectorf()
        moved = wp.spatial_vectorf()
        touch0_bar = zero
        touch1_bar = zero
        if body0 != body:
            n = wp.normalize(touch0 - start)
            slide = point_velocity(total, touch0 - com) - point_velocity(weigh(rates, f0), start - com0)
            turn = segment_turn(start, touch0, slide)
            along0 = wrench(-n, zero, start - com0)
            moved0 = end_wrench(start - com0, -n, -turn, rates, f0)
            # The tangent point's displacement is not the geom's: its cotangent goes through the wrap below.
            touch0_bar = turn + wp.cross(n, spin)
            along += wrench(n, zero, touch0 - com)
            moved += end_wrench(touch0 - com, n, -wp.cross(n, spin), rates, fg)
        if body1 != body:
            n = wp.normalize(end - touch1)
            slide = point_velocity(weigh(rates, f1), end - com1) - point_velocity(total, touch1 - com)
            turn = segment_turn(touch1, end, slide)
            along1 = wrench(n, zero, end - com1)
            moved1 = end_wrench(end - com1, n, turn, rates, f1)
            touch1_bar = -turn - wp.cross(n, spin)
            along += wrench(-n, zero, touch1 - com)
            moved += end_wrench(touch1 - com, -n, wp.cross(n, spin), rates, fg)
        mat = poses_in.geom_xmat[worldid, geom]
        pos = poses_in.geom_xpos[worldid, geom]
        start_bar = zero
        end_bar = zero
        pos_bar = zero
        mat_bar = wp.mat33(0.0)
        side_bar = zero
        spot = inside_in[worldid, e]
        if spot[3] != 0.0:
            start_bar, end_bar, pos_bar, mat_bar, _r, _k, _p, _w = wp.grad(inside_score)(
                start, end, pos, mat, radius, kind, wp.vec3(spot[0], spot[1], spot[2]), touch0_bar + touch1_bar
            )
        else:
            start_bar, end_bar, pos_bar, mat_bar, _r, _k, side_bar, _w0, _w1 = wp.grad(wrap_score)(
                start, end, pos, mat, radius, kind, side, touch0_bar, touch1_bar
            )
        # dR = [ω] R  ⇒  torque Σ_k R_k × R̄_k over the columns
        torque = zero
        for k in range(3):
            column = wp.vec3(mat[0, k], mat[1, k], mat[2, k])
            column_bar = wp.vec3(mat_bar[0, k], mat_bar[1, k], mat_bar[2, k])
            torque += wp.cross(column, column_bar)
        push_body(body0, worldid, along0, moved0 + wrench(start_bar, zero, start - com0), rates, bars_out)
        push_body(body1, worldid, along1, moved1 + wrench(end_bar, zero, end - com1), rates, bars_out)
        push_body(body, worldid, along, moved + wrench(pos_bar, torque, pos - com), rates, bars_out)
        sidesite = int(wp.round(paths.wrap_prm[place]))
        if sidesite >= 0:
            owner = paths.site_bodyid[sidesite]
            if owner > 0:
                arm = side - motion_in.subtree_com[worldid, paths.body_rootid[owner]]
                wp.atomic_add(bars_out.moved, worldid, owner, wrench(side_bar, zero, arm))


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
        work.launch_lanes(pull_paths, self.touch.shape[1], at, **points)
