"""Connect and weld equalities: two anchors held together, and for a weld two orientations.

A connect's rows are the world components of the relative motion of two anchors, 1 minus 2. Unlike contacts their
reference holds the whole acceleration of the anchors, so jar = acc₁ - acc₂ + b (u₁ - u₂) + k imp (p₁ - p₂) with
acc = A + α × r + ω × u(p), the acceleration of a body-fixed point; gravity, in A of every body, drops out.
A weld adds three rows for ts·vec(Q), Q = q₂* q₁ the relative orientation and ts its torque scale, whose two rates come
from both bodies' spins and angular accelerations; `turn_potential` holds them and is differentiated as it is.
"""

import warp as wp
from mujoco_warp import ObjType

from msk_ray.step.adjoint.groups import FieldBars, Fields, Motion, RowLaws, Rows, Substep
from msk_ray.step.adjoint.laws.impedance import row_slopes
from msk_ray.step.adjoint.spatial import carried, point_velocity, three, wrench
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import ConstraintType, EqType, vec5, vec12

wp.set_module_options({"enable_backward": False})


@wp.func
def quat_product(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Hamilton product of quaternions (w, x, y, z)."""
    u = wp.vec3(a[1], a[2], a[3])
    v = wp.vec3(b[1], b[2], b[3])
    w = a[0] * v + b[0] * u + wp.cross(u, v)
    return wp.vec4(a[0] * b[0] - wp.dot(u, v), w[0], w[1], w[2])


@wp.func
def turned(spin: wp.vec3, q: wp.vec4) -> wp.vec4:
    """[0, ω] q, twice the rate of q under a world spin."""
    return quat_product(wp.vec4(0.0, spin[0], spin[1], spin[2]), q)


@wp.func
def conjugate(q: wp.vec4) -> wp.vec4:
    """Inverse rotation."""
    return wp.vec4(q[0], -q[1], -q[2], -q[3])


@wp.func
def turn_potential(
    q1: wp.vec4,
    q2: wp.vec4,
    spin1: wp.vec3,
    spin2: wp.vec3,
    accel: wp.vec3,
    lam_spin: wp.vec3,
    y: wp.vec3,
    push: wp.vec3,
    place: wp.vec3,
    damping: wp.float32,
) -> wp.float32:
    """y·(Q̈ + b Q̇) - push·Q̇(λ) + place·Q in vector parts, the share of Φ whose slopes a weld's rotation has.

    Q = q₂* q₁ ,  2 Q̇ = q₂* Δω q₁ ,  2 Q̈ = q̇₂* Δω q₁ + q₂* Δα q₁ + q₂* Δω q̇₁.
    """
    inverse = conjugate(q2)
    spin = spin1 - spin2
    first = quat_product(inverse, turned(spin, q1))
    second = quat_product(conjugate(0.5 * turned(spin2, q2)), turned(spin, q1))
    second += quat_product(inverse, turned(accel, q1))
    second += quat_product(inverse, turned(spin, 0.5 * turned(spin1, q1)))
    under = quat_product(inverse, turned(lam_spin, q1))
    whole = quat_product(inverse, q1)
    motion = 0.5 * (second + damping * first)
    potential = wp.dot(y, wp.vec3(motion[1], motion[2], motion[3]))
    potential -= 0.5 * wp.dot(push, wp.vec3(under[1], under[2], under[3]))
    return potential + wp.dot(place, wp.vec3(whole[1], whole[2], whole[3]))


@wp.func
def as_vec4(q: wp.quat) -> wp.vec4:
    """MuJoCo's quaternion (w, x, y, z), kept in a wp.quat in that order."""
    return wp.vec4(q[0], q[1], q[2], q[3])


@wp.func
def spin_of(q: wp.vec4, bar: wp.vec4) -> wp.vec3:
    """dq = ½ [0, w] q  ⇒  torque ½ vec(q̄ q*)."""
    p = quat_product(bar, conjugate(q))
    return 0.5 * wp.vec3(p[1], p[2], p[3])


@wp.struct
class Anchors:
    """Parameters of equalities, and the bodies and sites they hold."""

    body_rootid: wp.array[int]
    site_bodyid: wp.array[int]
    site_quat: wp.array2d[wp.quat]
    eq_type: wp.array[int]
    eq_objtype: wp.array[int]
    eq_obj1id: wp.array[int]
    eq_obj2id: wp.array[int]
    eq_solref: wp.array2d[wp.vec2]
    eq_solimp: wp.array2d[vec5]
    eq_data: wp.array2d[vec12]


@wp.kernel
def pull_anchors(
    lanes: int,
    count: int,
    # Model:
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    anchors: Anchors,
    # In:
    nefc_in: wp.array[int],
    rows_in: Rows,
    laws_in: RowLaws,
    xpos_in: wp.array2d[wp.vec3],
    xquat_in: wp.array2d[wp.quat],
    xmat_in: wp.array2d[wp.mat33],
    site_xpos_in: wp.array2d[wp.vec3],
    motion_in: Motion,
    fields_in: Fields,
    # Out:
    bars_out: FieldBars,
) -> None:
    """Φ ∋ -ρ(λ)·f(jar): at the first row of an equality, for all its three or six.

    `lanes` threads take the first `count` rows of a world in turn.
    """
    worldid, lane = wp.tid()
    for row in range(lane, count, lanes):
        if row + 2 >= wp.min(nefc_in[worldid], laws_in.slope.shape[1]):
            continue
        if rows_in.type[worldid, row] != ConstraintType.EQUALITY:
            continue
        eq = rows_in.id[worldid, row]
        weld = anchors.eq_type[eq] == EqType.WELD
        if anchors.eq_type[eq] != EqType.CONNECT and not weld:
            continue
        if weld and row + 5 >= wp.min(nefc_in[worldid], laws_in.slope.shape[1]):
            continue
        # Rows of one equality are consecutive: the first is the one before which another equality ends.
        if row > 0:
            if rows_in.type[worldid, row - 1] == ConstraintType.EQUALITY and rows_in.id[worldid, row - 1] == eq:
                continue
        data = anchors.eq_data[worldid % anchors.eq_data.shape[0], eq]
        body1 = anchors.eq_obj1id[eq]
        body2 = anchors.eq_obj2id[eq]
        point1 = wp.vec3(0.0)
        point2 = wp.vec3(0.0)
        q1 = wp.vec4(1.0, 0.0, 0.0, 0.0)
        q2 = wp.vec4(1.0, 0.0, 0.0, 0.0)
        if anchors.eq_objtype[eq] == ObjType.SITE:
            site1 = body1
            site2 = body2
            point1 = site_xpos_in[worldid, site1]
            point2 = site_xpos_in[worldid, site2]
            body1 = anchors.site_bodyid[site1]
            body2 = anchors.site_bodyid[site2]
            rest = worldid % anchors.site_quat.shape[0]
            q1 = quat_product(as_vec4(xquat_in[worldid, body1]), as_vec4(anchors.site_quat[rest, site1]))
            q2 = quat_product(as_vec4(xquat_in[worldid, body2]), as_vec4(anchors.site_quat[rest, site2]))
        else:
            anchor1 = wp.vec3(data[0], data[1], data[2])
            anchor2 = wp.vec3(data[3], data[4], data[5])
            if weld:
                # A weld lists its second body's anchor first.
                anchor1 = wp.vec3(data[3], data[4], data[5])
                anchor2 = wp.vec3(data[0], data[1], data[2])
                q1 = quat_product(as_vec4(xquat_in[worldid, body1]), wp.vec4(data[6], data[7], data[8], data[9]))
                q2 = as_vec4(xquat_in[worldid, body2])
            point1 = xpos_in[worldid, body1] + xmat_in[worldid, body1] @ anchor1
            point2 = xpos_in[worldid, body2] + xmat_in[worldid, body2] @ anchor2
        gap = point1 - point2
        turn = wp.vec3(0.0)
        scale = float(0.0)
        if weld:
            scale = data[10]
            whole = quat_product(conjugate(q2), q1)
            turn = scale * wp.vec3(whole[1], whole[2], whole[3])
        size = wp.sqrt(wp.dot(gap, gap) + wp.dot(turn, turn))
        arm1 = point1 - motion_in.subtree_com[worldid, anchors.body_rootid[body1]]
        arm2 = point2 - motion_in.subtree_com[worldid, anchors.body_rootid[body2]]
        rate = point_velocity(fields_in.lam[worldid, body1], arm1) - point_velocity(fields_in.lam[worldid, body2], arm2)
        mass = laws_in.slope[worldid, row]
        # ∂Φ/∂jar = D ρ(λ)
        y = mass * rate
        push = three(laws_in.force, worldid, row)

        # All three rows share the impedance at |gap|: slopes at pos = |gap| along the gap.
        solref = anchors.eq_solref[worldid % anchors.eq_solref.shape[0], eq]
        solimp = anchors.eq_solimp[worldid % anchors.eq_solimp.shape[0], eq]
        timestep = opt_timestep[worldid % opt_timestep.shape[0]]
        slopes = row_slopes(opt_disableflags, timestep, solref, solimp, size)
        lam_spin = wp.spatial_top(fields_in.lam[worldid, body1]) - wp.spatial_top(fields_in.lam[worldid, body2])
        spin1 = wp.spatial_top(motion_in.cvel[worldid, body1])
        spin2 = wp.spatial_top(motion_in.cvel[worldid, body2])
        accel = wp.spatial_top(fields_in.cacc[worldid, body1]) - wp.spatial_top(fields_in.cacc[worldid, body2])
        turn_y = wp.vec3(0.0)
        turn_push = wp.vec3(0.0)
        turn_rate = wp.vec3(0.0)
        if weld:
            under = quat_product(conjugate(q2), turned(lam_spin, q1))
            turn_rate = 0.5 * scale * wp.vec3(under[1], under[2], under[3])
            turn_y = laws_in.slope[worldid, row + 3] * turn_rate
            turn_push = three(laws_in.force, worldid, row + 3)
        along = wp.vec3(0.0)
        turn_along = wp.vec3(0.0)
        if size > 1.0e-12:
            along = gap / size
            turn_along = turn / size
        # stiffness = k (imp + imp' s): its part k imp acts on every row, the rest through the common distance s alone
        straight = slopes.spring
        bend = (slopes.stiffness - straight) * (wp.dot(along, y) + wp.dot(turn_along, turn_y))
        bend -= slopes.mass * (wp.dot(rate, push) + wp.dot(turn_rate, turn_push))
        place = straight * y + bend * along
        damp = slopes.damping
        torque1 = wp.vec3(0.0)
        torque2 = wp.vec3(0.0)
        spin1_bar = wp.vec3(0.0)
        spin2_bar = wp.vec3(0.0)
        accel_bar = wp.vec3(0.0)
        under_bar = wp.vec3(0.0)
        if weld:
            g1, g2, gs1, gs2, ga, gl, _y, _p, _c, _d = wp.grad(turn_potential)(
                q1,
                q2,
                spin1,
                spin2,
                accel,
                lam_spin,
                scale * turn_y,
                scale * turn_push,
                scale * (straight * turn_y + bend * turn_along),
                damp,
            )
            torque1 = spin_of(q1, g1)
            torque2 = spin_of(q2, g2)
            spin1_bar = gs1
            spin2_bar = gs2
            accel_bar = ga
            under_bar = gl

        for side in range(2):
            body = body1
            arm = arm1
            sign = float(1.0)
            spin_bar = spin1_bar
            torque = torque1
            if side == 1:
                body = body2
                arm = arm2
                sign = float(-1.0)
                spin_bar = spin2_bar
                torque = torque2
            if body > 0:
                lam = fields_in.lam[worldid, body]
                vel = motion_in.cvel[worldid, body]
                acc = fields_in.cacc[worldid, body]
                omega = wp.spatial_top(vel)
                alpha = wp.spatial_top(acc)
                speed = point_velocity(vel, arm)
                yy = sign * y
                lam_wrench = wrench(-sign * push, sign * under_bar, arm)
                acc_wrench = wrench(yy, sign * accel_bar, arm)
                # y·(dω × u + ω × du): torque u × y, and y × ω on the point's velocity, which b u joins
                swirl = wp.cross(yy, omega)
                vel_wrench = wrench(swirl + damp * yy, wp.cross(speed, yy) + spin_bar, arm)
                # dp enters as α × dp + ω × (ω × dp), and in u(λ) and b u
                moved = wp.cross(yy, alpha) + wp.cross(swirl + damp * yy, omega)
                moved += wp.cross(-sign * push, wp.spatial_top(lam)) + sign * place
                wp.atomic_add(bars_out.lam, worldid, body, lam_wrench)
                wp.atomic_add(bars_out.cacc, worldid, body, acc_wrench)
                wp.atomic_add(bars_out.qvel, worldid, body, vel_wrench)
                total = carried(lam, lam_wrench) + carried(acc, acc_wrench) + carried(vel, vel_wrench)
                wp.atomic_add(bars_out.moved, worldid, body, total + wrench(moved, torque, arm))


def launch_anchors(work: Workspace, at: Substep) -> None:
    """Launch what connect and weld equalities give ∂Φ."""
    work.launch_lanes(pull_anchors, work.njmax, at)
