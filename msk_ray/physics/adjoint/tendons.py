"""Tendons: passive forces, and cotangents of length and rates pulled back along the path.

A tendon's rate under a plain field x is ρ(x) = J x. Φ holds tendons through their length l and through ρ(v), ρ(λ),
ρ(a), and with implicit integration also ρ(μ) and ρ(a - â). J l̄ is the gradient that any tendon has; a spatial
tendon's J turns with q as well, which `pull_paths` works out segment by segment:

    ρ(x) = n·(u₂(x) - u₁(x)) ,  n = (p₂ - p₁)/|p₂ - p₁| ,  u the velocities of the segment's ends under x.

On a wrapping geom the ends are tangent points that move over the surface; the rate sees them fixed to the geom's body
(the length is stationary in them), its own change sees them move.
"""

import warp as wp

from msk_ray.physics.adjoint.spatial import carried, point_velocity, wrench
from msk_ray.physics.mjw_private import MJ_MAXVAL, WrapType, poly_force_deriv, tendon_damping_total, wrap

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


@wp.func
def tendon_rate(
    rownnz: int, rowadr: int, colind: wp.array[int], jacobian: wp.array[float], x: wp.array[float]
) -> float:
    """J x of one tendon in one world."""
    rate = float(0.0)
    for k in range(rowadr, rowadr + rownnz):
        rate += jacobian[k] * x[colind[k]]
    return rate


@wp.kernel
def start_tendons(
    # Model:
    opt_timestep: wp.array[float],
    spring_on: bool,
    damper_on: bool,
    implicit_all: bool,
    tendon_actuatorid: wp.array[int],
    ten_J_rownnz: wp.array[int],
    ten_J_rowadr: wp.array[int],
    ten_J_colind: wp.array[int],
    tendon_stiffness: wp.array2d[float],
    tendon_stiffnesspoly: wp.array2d[wp.vec2],
    tendon_damping: wp.array2d[float],
    tendon_dampingpoly: wp.array2d[wp.vec2],
    tendon_lengthspring: wp.array2d[wp.vec2],
    actuator_trntype: wp.array[int],
    actuator_trnid: wp.array[wp.vec2i],
    actuator_damping: wp.array2d[float],
    actuator_dampingpoly: wp.array2d[wp.vec2],
    actuator_gear: wp.array2d[wp.spatial_vector],
    inertia_address: wp.array2d[int],
    # In:
    qvel_in: wp.array2d[float],
    qacc_in: wp.array2d[float],
    ten_J_in: wp.array2d[float],
    ten_length_in: wp.array2d[float],
    lam_in: wp.array2d[float],
    mu_in: wp.array2d[float],
    excess_in: wp.array2d[float],
    # Out:
    length_bar_out: wp.array2d[float],
    qvel_bar_out: wp.array2d[float],
    lam_bar_out: wp.array2d[float],
    qacc_bar_out: wp.array2d[float],
    mu_bar_out: wp.array2d[float],
    smooth_bar_out: wp.array2d[float],
) -> None:
    """Starts each tendon's cotangents with those of its spring and damper: Φ ∋ ρ(λ) (k(x) x + c(|ρ(v)|) ρ(v)).

    With implicit integration also Φ ∋ h μᵀ B â where B ∋ d(c ρ)/dρ J Jᵀ on the entries that M has.
    """
    worldid, t = wp.tid()
    rate_v = tendon_rate(ten_J_rownnz[t], ten_J_rowadr[t], ten_J_colind, ten_J_in[worldid], qvel_in[worldid])
    rate_l = tendon_rate(ten_J_rownnz[t], ten_J_rowadr[t], ten_J_colind, ten_J_in[worldid], lam_in[worldid])
    length_bar = float(0.0)
    qvel_bar = float(0.0)
    lam_bar = float(0.0)
    mu_bar = float(0.0)
    smooth_bar = float(0.0)
    if spring_on:
        rest = tendon_lengthspring[worldid % tendon_lengthspring.shape[0], t]
        stiffness = tendon_stiffness[worldid % tendon_stiffness.shape[0], t]
        poly = tendon_stiffnesspoly[worldid % tendon_stiffnesspoly.shape[0], t]
        length = ten_length_in[worldid, t]
        x = float(0.0)
        if length > rest[1]:
            x = length - rest[1]
        elif length < rest[0]:
            x = length - rest[0]
        # A spring without a dead band has its stiffness at rest too.
        if x != 0.0 or rest[0] == rest[1]:
            lam_bar += x * (stiffness + poly[0] * x + poly[1] * x * x)
            length_bar += rate_l * poly_force_deriv(stiffness, poly, x, 0)
    if damper_on:
        c, bend = tendon_damping_total(
            tendon_actuatorid,
            tendon_damping,
            tendon_dampingpoly,
            actuator_trntype,
            actuator_trnid,
            actuator_damping,
            actuator_dampingpoly,
            actuator_gear,
            worldid,
            t,
        )
        speed = wp.abs(rate_v)
        slope = poly_force_deriv(c, bend, rate_v, 1)
        lam_bar += rate_v * (c + bend[0] * speed + bend[1] * speed * speed)
        qvel_bar += rate_l * slope
        if implicit_all and (c != 0.0 or bend[0] != 0.0 or bend[1] != 0.0):
            h = opt_timestep[worldid % opt_timestep.shape[0]]
            # κ = Σ J_i J_j μ_i â_j over the pairs that M couples
            kappa = float(0.0)
            start = ten_J_rowadr[t]
            for k in range(start, start + ten_J_rownnz[t]):
                i = ten_J_colind[k]
                for m in range(start, start + ten_J_rownnz[t]):
                    j = ten_J_colind[m]
                    if inertia_address[wp.max(i, j), wp.min(i, j)] >= 0:
                        smooth = qacc_in[worldid, j] - excess_in[worldid, j]
                        kappa += ten_J_in[worldid, k] * ten_J_in[worldid, m] * mu_in[worldid, i] * smooth
            qvel_bar += h * kappa * wp.sign(rate_v) * (2.0 * bend[0] + 6.0 * bend[1] * speed)
            rate_mu = tendon_rate(ten_J_rownnz[t], ten_J_rowadr[t], ten_J_colind, ten_J_in[worldid], mu_in[worldid])
            rate_a = tendon_rate(ten_J_rownnz[t], ten_J_rowadr[t], ten_J_colind, ten_J_in[worldid], qacc_in[worldid])
            rate_e = tendon_rate(ten_J_rownnz[t], ten_J_rowadr[t], ten_J_colind, ten_J_in[worldid], excess_in[worldid])
            mu_bar = h * slope * (rate_a - rate_e)
            smooth_bar = h * slope * rate_mu
    length_bar_out[worldid, t] = length_bar
    qvel_bar_out[worldid, t] = qvel_bar
    lam_bar_out[worldid, t] = lam_bar
    qacc_bar_out[worldid, t] = 0.0
    mu_bar_out[worldid, t] = mu_bar
    smooth_bar_out[worldid, t] = smooth_bar


@wp.kernel
def pull_tendons(
    # Model:
    ten_J_rownnz: wp.array[int],
    ten_J_rowadr: wp.array[int],
    ten_J_colind: wp.array[int],
    tendon_adr: wp.array[int],
    wrap_type: wp.array[int],
    # In:
    ten_J_in: wp.array2d[float],
    length_bar_in: wp.array2d[float],
    qvel_bar_in: wp.array2d[float],
    # Out:
    phi_qpos_out: wp.array2d[float],
    phi_qvel_out: wp.array2d[float],
) -> None:
    """∂Φ/∂q ∋ J l̄, and for fixed tendons ∂Φ/∂v ∋ J ρ̄(v); spatial ones give that to their bodies."""
    worldid, t, k = wp.tid()
    if k >= ten_J_rownnz[t]:
        return
    place = ten_J_rowadr[t] + k
    j = ten_J_in[worldid, place]
    wp.atomic_add(phi_qpos_out, worldid, ten_J_colind[place], j * length_bar_in[worldid, t])
    if wrap_type[tendon_adr[t]] == WrapType.JOINT:
        wp.atomic_add(phi_qvel_out, worldid, ten_J_colind[place], j * qvel_bar_in[worldid, t])


@wp.struct
class Rates:
    """Cotangents of one tendon's rates, times its pulley's share."""

    lam: float
    qacc: float
    qvel: float
    mu: float
    smooth: float


@wp.struct
class Fields:
    """Plain fields of one body."""

    lam: wp.spatial_vectorf
    qacc: wp.spatial_vectorf
    qvel: wp.spatial_vectorf
    mu: wp.spatial_vectorf
    smooth: wp.spatial_vectorf


@wp.func
def weigh(rates: Rates, fields: Fields) -> wp.spatial_vectorf:
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
def push_point(
    body: int,
    worldid: int,
    arm: wp.vec3,
    direction: wp.vec3,
    turn: wp.vec3,
    rates: Rates,
    fields: Fields,
    lam_bar_out: wp.array2d[wp.spatial_vector],
    qacc_bar_out: wp.array2d[wp.spatial_vector],
    qvel_bar_out: wp.array2d[wp.spatial_vector],
    mu_bar_out: wp.array2d[wp.spatial_vector],
    excess_bar_out: wp.array2d[wp.spatial_vector],
    moved_bar_out: wp.array2d[wp.spatial_vector],
) -> None:
    """Adds what one end of a segment gives its body: rates ρ̄(x) along `direction`, and the end's own cotangent."""
    if body > 0:
        zero = wp.vec3(0.0)
        along = wrench(direction, zero, arm)
        total = weigh(rates, fields)
        wp.atomic_add(lam_bar_out, worldid, body, rates.lam * along)
        # â = a - (a - â): its cotangent goes to both fields
        wp.atomic_add(qacc_bar_out, worldid, body, (rates.qacc + rates.smooth) * along)
        wp.atomic_add(qvel_bar_out, worldid, body, rates.qvel * along)
        if rates.mu != 0.0 or rates.smooth != 0.0:
            wp.atomic_add(mu_bar_out, worldid, body, rates.mu * along)
            wp.atomic_add(excess_bar_out, worldid, body, -rates.smooth * along)
        # The velocity of the end changes with its place as ω × dp ⇒ p̄ ∋ direction × Σ ρ̄ ω
        place = turn + wp.cross(direction, wp.spatial_top(total))
        wp.atomic_add(moved_bar_out, worldid, body, carried(total, along) + wrench(place, zero, arm))


@wp.func
def fields_of(
    body: int,
    worldid: int,
    lam_field_in: wp.array2d[wp.spatial_vector],
    qacc_field_in: wp.array2d[wp.spatial_vector],
    cvel_in: wp.array2d[wp.spatial_vector],
    mu_field_in: wp.array2d[wp.spatial_vector],
    excess_field_in: wp.array2d[wp.spatial_vector],
) -> Fields:
    """Fields of one body."""
    out = Fields()
    out.lam = lam_field_in[worldid, body]
    out.qacc = qacc_field_in[worldid, body]
    out.qvel = cvel_in[worldid, body]
    out.mu = mu_field_in[worldid, body]
    out.smooth = out.qacc - excess_field_in[worldid, body]
    return out


@wp.kernel
def pull_paths(
    # Model:
    body_rootid: wp.array[int],
    geom_bodyid: wp.array[int],
    geom_size: wp.array2d[wp.vec3],
    site_bodyid: wp.array[int],
    wrap_type: wp.array[int],
    wrap_objid: wp.array[int],
    wrap_prm: wp.array[float],
    wrap_pulley_scale: wp.array[float],
    segment_tendon: wp.array[int],
    segment_first: wp.array[int],
    segment_geom: wp.array[int],
    segment_last: wp.array[int],
    # In:
    touch_in: wp.array2d[wp.spatial_vector],
    geom_xpos_in: wp.array2d[wp.vec3],
    geom_xmat_in: wp.array2d[wp.mat33],
    site_xpos_in: wp.array2d[wp.vec3],
    subtree_com_in: wp.array2d[wp.vec3],
    lam_field_in: wp.array2d[wp.spatial_vector],
    qacc_field_in: wp.array2d[wp.spatial_vector],
    cvel_in: wp.array2d[wp.spatial_vector],
    mu_field_in: wp.array2d[wp.spatial_vector],
    excess_field_in: wp.array2d[wp.spatial_vector],
    ten_lam_bar_in: wp.array2d[float],
    ten_qacc_bar_in: wp.array2d[float],
    ten_qvel_bar_in: wp.array2d[float],
    ten_mu_bar_in: wp.array2d[float],
    ten_smooth_bar_in: wp.array2d[float],
    # Out:
    lam_bar_out: wp.array2d[wp.spatial_vector],
    qacc_bar_out: wp.array2d[wp.spatial_vector],
    qvel_bar_out: wp.array2d[wp.spatial_vector],
    mu_bar_out: wp.array2d[wp.spatial_vector],
    excess_bar_out: wp.array2d[wp.spatial_vector],
    moved_bar_out: wp.array2d[wp.spatial_vector],
) -> None:
    """How J x of a spatial tendon turns with q: one thread a stretch of path between two sites, geom or not."""
    worldid, e = wp.tid()
    t = segment_tendon[e]
    first = segment_first[e]
    share = wrap_pulley_scale[first]
    rates = Rates()
    rates.lam = share * ten_lam_bar_in[worldid, t]
    rates.qacc = share * ten_qacc_bar_in[worldid, t]
    rates.qvel = share * ten_qvel_bar_in[worldid, t]
    rates.mu = share * ten_mu_bar_in[worldid, t]
    rates.smooth = share * ten_smooth_bar_in[worldid, t]
    site0 = wrap_objid[first]
    site1 = wrap_objid[segment_last[e]]
    body0 = site_bodyid[site0]
    body1 = site_bodyid[site1]
    start = site_xpos_in[worldid, site0]
    end = site_xpos_in[worldid, site1]
    com0 = subtree_com_in[worldid, body_rootid[body0]]
    com1 = subtree_com_in[worldid, body_rootid[body1]]
    f0 = fields_of(body0, worldid, lam_field_in, qacc_field_in, cvel_in, mu_field_in, excess_field_in)
    f1 = fields_of(body1, worldid, lam_field_in, qacc_field_in, cvel_in, mu_field_in, excess_field_in)

    place = segment_geom[e]
    geom = int(0)
    kind = int(0)
    radius = float(0.0)
    side = wp.vec3(MJ_MAXVAL)
    if place >= 0:
        geom = wrap_objid[place]
        kind = wrap_type[place]
        radius = geom_size[worldid % geom_size.shape[0], geom][0]
        sidesite = int(wp.round(wrap_prm[place]))
        if sidesite >= 0:
            side = site_xpos_in[worldid, sidesite]
    touch0 = wp.spatial_top(touch_in[worldid, e])
    touch1 = wp.spatial_bottom(touch_in[worldid, e])
    if touch_in[worldid, e][0] >= MJ_MAXVAL:
        if body0 == body1:
            return
        n = wp.normalize(end - start)
        slide = point_velocity(weigh(rates, f1), end - com1) - point_velocity(weigh(rates, f0), start - com0)
        turn = segment_turn(start, end, slide)
        push_point(
            body0, worldid, start - com0, -n, -turn, rates, f0,
            lam_bar_out, qacc_bar_out, qvel_bar_out, mu_bar_out, excess_bar_out, moved_bar_out,
        )  # fmt: skip
        push_point(
            body1, worldid, end - com1, n, turn, rates, f1,
            lam_bar_out, qacc_bar_out, qvel_bar_out, mu_bar_out, excess_bar_out, moved_bar_out,
        )  # fmt: skip
        return

    body = geom_bodyid[geom]
    com = subtree_com_in[worldid, body_rootid[body]]
    fg = fields_of(body, worldid, lam_field_in, qacc_field_in, cvel_in, mu_field_in, excess_field_in)
    total = weigh(rates, fg)
    zero = wp.vec3(0.0)
    touch0_bar = zero
    touch1_bar = zero
    if body0 != body:
        n = wp.normalize(touch0 - start)
        slide = point_velocity(total, touch0 - com) - point_velocity(weigh(rates, f0), start - com0)
        turn = segment_turn(start, touch0, slide)
        push_point(
            body0, worldid, start - com0, -n, -turn, rates, f0,
            lam_bar_out, qacc_bar_out, qvel_bar_out, mu_bar_out, excess_bar_out, moved_bar_out,
        )  # fmt: skip
        # The tangent point's displacement is not the geom's: its cotangent goes through the wrap below.
        touch0_bar = turn + wp.cross(n, wp.spatial_top(total))
        push_point(
            body, worldid, touch0 - com, n, -wp.cross(n, wp.spatial_top(total)), rates, fg,
            lam_bar_out, qacc_bar_out, qvel_bar_out, mu_bar_out, excess_bar_out, moved_bar_out,
        )  # fmt: skip
    if body1 != body:
        n = wp.normalize(end - touch1)
        slide = point_velocity(weigh(rates, f1), end - com1) - point_velocity(total, touch1 - com)
        turn = segment_turn(touch1, end, slide)
        push_point(
            body1, worldid, end - com1, n, turn, rates, f1,
            lam_bar_out, qacc_bar_out, qvel_bar_out, mu_bar_out, excess_bar_out, moved_bar_out,
        )  # fmt: skip
        touch1_bar = -turn - wp.cross(n, wp.spatial_top(total))
        push_point(
            body, worldid, touch1 - com, -n, wp.cross(n, wp.spatial_top(total)), rates, fg,
            lam_bar_out, qacc_bar_out, qvel_bar_out, mu_bar_out, excess_bar_out, moved_bar_out,
        )  # fmt: skip
    mat = geom_xmat_in[worldid, geom]
    pos = geom_xpos_in[worldid, geom]
    start_bar, end_bar, pos_bar, mat_bar, _r, _k, side_bar, _w0, _w1 = wp.grad(wrap_score)(
        start, end, pos, mat, radius, kind, side, touch0_bar, touch1_bar
    )
    # dR = [ω] R  ⇒  torque Σ_k R_k × R̄_k over the columns
    torque = zero
    for k in range(3):
        column = wp.vec3(mat[0, k], mat[1, k], mat[2, k])
        column_bar = wp.vec3(mat_bar[0, k], mat_bar[1, k], mat_bar[2, k])
        torque += wp.cross(column, column_bar)
    if body0 > 0:
        wp.atomic_add(moved_bar_out, worldid, body0, wrench(start_bar, zero, start - com0))
    if body1 > 0:
        wp.atomic_add(moved_bar_out, worldid, body1, wrench(end_bar, zero, end - com1))
    if body > 0:
        wp.atomic_add(moved_bar_out, worldid, body, wrench(pos_bar, torque, pos - com))
    sidesite = int(wp.round(wrap_prm[place]))
    if sidesite >= 0:
        owner = site_bodyid[sidesite]
        if owner > 0:
            arm = side - subtree_com_in[worldid, body_rootid[owner]]
            wp.atomic_add(moved_bar_out, worldid, owner, wrench(side_bar, zero, arm))
