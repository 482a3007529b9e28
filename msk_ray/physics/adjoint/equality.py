"""Connect equalities: two anchors held together.

A connect's rows are the world components of the relative motion of two anchors, 1 minus 2. Unlike contacts their
reference holds the whole acceleration of the anchors, so jar = acc₁ - acc₂ + b (u₁ - u₂) + k imp (p₁ - p₂) with
acc = A + α × r + ω × u(p), the acceleration of a body-fixed point; gravity, in A of every body, drops out.
"""

import warp as wp
from mujoco_warp._src.types import ConstraintType, EqType, ObjType, vec5, vec12

from msk_ray.physics.adjoint.rows import row_slopes
from msk_ray.physics.adjoint.spatial import carried, point_velocity, wrench

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pull_connects(
    # Model:
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    body_rootid: wp.array[int],
    site_bodyid: wp.array[int],
    eq_type: wp.array[int],
    eq_objtype: wp.array[int],
    eq_obj1id: wp.array[int],
    eq_obj2id: wp.array[int],
    eq_solref: wp.array2d[wp.vec2],
    eq_solimp: wp.array2d[vec5],
    eq_data: wp.array2d[vec12],
    # In:
    nefc_in: wp.array[int],
    type_in: wp.array2d[int],
    id_in: wp.array2d[int],
    slope_in: wp.array2d[float],
    force_in: wp.array2d[float],
    xpos_in: wp.array2d[wp.vec3],
    xmat_in: wp.array2d[wp.mat33],
    site_xpos_in: wp.array2d[wp.vec3],
    subtree_com_in: wp.array2d[wp.vec3],
    lam_field_in: wp.array2d[wp.spatial_vector],
    cvel_in: wp.array2d[wp.spatial_vector],
    cacc_in: wp.array2d[wp.spatial_vector],
    # Out:
    lam_bar_out: wp.array2d[wp.spatial_vector],
    qvel_bar_out: wp.array2d[wp.spatial_vector],
    cacc_bar_out: wp.array2d[wp.spatial_vector],
    moved_bar_out: wp.array2d[wp.spatial_vector],
):
    """Φ ∋ -ρ(λ)·f(jar): one thread a row; that of a connect's first row does all three."""
    worldid, row = wp.tid()
    if row + 2 >= wp.min(nefc_in[worldid], slope_in.shape[1]):
        return
    if type_in[worldid, row] != ConstraintType.EQUALITY:
        return
    eq = id_in[worldid, row]
    if eq_type[eq] != EqType.CONNECT:
        return
    # Rows of one equality are consecutive: the first is the one before which another equality ends.
    if row > 0:
        if type_in[worldid, row - 1] == ConstraintType.EQUALITY and id_in[worldid, row - 1] == eq:
            return
    data = eq_data[worldid % eq_data.shape[0], eq]
    body1 = eq_obj1id[eq]
    body2 = eq_obj2id[eq]
    point1 = wp.vec3(0.0)
    point2 = wp.vec3(0.0)
    if eq_objtype[eq] == ObjType.SITE:
        point1 = site_xpos_in[worldid, body1]
        point2 = site_xpos_in[worldid, body2]
        body1 = site_bodyid[body1]
        body2 = site_bodyid[body2]
    else:
        point1 = xpos_in[worldid, body1] + xmat_in[worldid, body1] @ wp.vec3(data[0], data[1], data[2])
        point2 = xpos_in[worldid, body2] + xmat_in[worldid, body2] @ wp.vec3(data[3], data[4], data[5])
    gap = point1 - point2
    size = wp.length(gap)
    arm1 = point1 - subtree_com_in[worldid, body_rootid[body1]]
    arm2 = point2 - subtree_com_in[worldid, body_rootid[body2]]
    rate = point_velocity(lam_field_in[worldid, body1], arm1) - point_velocity(lam_field_in[worldid, body2], arm2)
    mass = slope_in[worldid, row]
    # ∂Φ/∂jar = D ρ(λ)
    y = mass * rate
    push = wp.vec3(force_in[worldid, row], force_in[worldid, row + 1], force_in[worldid, row + 2])

    # All three rows share the impedance at |gap|: slopes at pos = |gap| along the gap.
    solref = eq_solref[worldid % eq_solref.shape[0], eq]
    solimp = eq_solimp[worldid % eq_solimp.shape[0], eq]
    timestep = opt_timestep[worldid % opt_timestep.shape[0]]
    slopes = row_slopes(opt_disableflags, timestep, solref, solimp, size)
    along = wp.vec3(0.0)
    if size > 1.0e-12:
        along = gap / size
    # stiffness = k (imp + imp' |gap|): its part k imp acts across the gap as well, the rest along it
    straight = slopes.spring
    place = straight * y + along * ((slopes.stiffness - straight) * wp.dot(along, y) - slopes.mass * wp.dot(rate, push))
    damp = slopes.damping

    for side in range(2):
        body = body1
        arm = arm1
        sign = float(1.0)
        if side == 1:
            body = body2
            arm = arm2
            sign = float(-1.0)
        if body > 0:
            lam = lam_field_in[worldid, body]
            vel = cvel_in[worldid, body]
            acc = cacc_in[worldid, body]
            omega = wp.spatial_top(vel)
            alpha = wp.spatial_top(acc)
            speed = point_velocity(vel, arm)
            yy = sign * y
            zero = wp.vec3(0.0)
            lam_wrench = wrench(-sign * push, zero, arm)
            acc_wrench = wrench(yy, zero, arm)
            # y·(dω × u + ω × du): torque u × y, and y × ω on the point's velocity, which b u joins
            swirl = wp.cross(yy, omega)
            vel_wrench = wrench(swirl + damp * yy, wp.cross(speed, yy), arm)
            # dp enters as α × dp + ω × (ω × dp), and in u(λ) and b u
            moved = wp.cross(yy, alpha) + wp.cross(swirl + damp * yy, omega)
            moved += wp.cross(-sign * push, wp.spatial_top(lam)) + sign * place
            wp.atomic_add(lam_bar_out, worldid, body, lam_wrench)
            wp.atomic_add(cacc_bar_out, worldid, body, acc_wrench)
            wp.atomic_add(qvel_bar_out, worldid, body, vel_wrench)
            total = carried(lam, lam_wrench) + carried(acc, acc_wrench) + carried(vel, vel_wrench)
            wp.atomic_add(moved_bar_out, worldid, body, total + wrench(moved, zero, arm))
