"""Constraint rows of joints and tendons: limits, friction loss, and joint and tendon equalities."""

import math

import warp as wp
from mujoco_warp import JointType

from msk_ray.physics.adjoint.rows import row_slopes
from msk_ray.physics.adjoint.tendons import tendon_rate
from msk_ray.physics.mjw_private import ConstraintType, EqType, vec5, vec12

wp.set_module_options({"enable_backward": False})

_PI = wp.constant(math.pi)


@wp.func
def add_joint_row(
    worldid: int,
    dof: int,
    sign: float,
    pos_bar: float,
    vel_bar: float,
    phi_qpos_out: wp.array2d[float],
    phi_qvel_out: wp.array2d[float],
) -> None:
    """A row with ρ(x) = sign·x_j and d(pos) = sign·dq_j."""
    wp.atomic_add(phi_qpos_out, worldid, dof, sign * pos_bar)
    wp.atomic_add(phi_qvel_out, worldid, dof, sign * vel_bar)


@wp.func
def add_tendon_row(
    worldid: int,
    t: int,
    sign: float,
    bars: wp.vec4,
    length_bar_out: wp.array2d[float],
    qvel_bar_out: wp.array2d[float],
    lam_bar_out: wp.array2d[float],
    qacc_bar_out: wp.array2d[float],
) -> None:
    """A row with ρ(x) = sign·J_t x and d(pos) = sign·dl; bars are cotangents of (pos, ρ(v), ρ(λ), ρ(a))."""
    wp.atomic_add(length_bar_out, worldid, t, sign * bars[0])
    wp.atomic_add(qvel_bar_out, worldid, t, sign * bars[1])
    wp.atomic_add(lam_bar_out, worldid, t, sign * bars[2])
    wp.atomic_add(qacc_bar_out, worldid, t, sign * bars[3])


@wp.func
def quat_angle_axis(q: wp.vec4) -> wp.vec4:
    """(axis, angle in [0, π]) of a quaternion (w, x, y, z)."""
    u = wp.vec3(q[1], q[2], q[3])
    sine = wp.length(u)
    if sine == 0.0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    axis = u / sine
    angle = 2.0 * wp.atan2(sine, q[0])
    if angle > _PI:
        angle = 2.0 * _PI - angle
        axis = -axis
    return wp.vec4(axis[0], axis[1], axis[2], angle)


@wp.kernel
def pull_rows(
    # Model:
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    qpos0: wp.array2d[float],
    jnt_type: wp.array[int],
    jnt_qposadr: wp.array[int],
    jnt_dofadr: wp.array[int],
    jnt_solref: wp.array2d[wp.vec2],
    jnt_solimp: wp.array2d[vec5],
    dof_solref: wp.array2d[wp.vec2],
    dof_solimp: wp.array2d[vec5],
    ten_J_rownnz: wp.array[int],
    ten_J_rowadr: wp.array[int],
    ten_J_colind: wp.array[int],
    tendon_solref_lim: wp.array2d[wp.vec2],
    tendon_solimp_lim: wp.array2d[vec5],
    tendon_solref_fri: wp.array2d[wp.vec2],
    tendon_solimp_fri: wp.array2d[vec5],
    tendon_range: wp.array2d[wp.vec2],
    tendon_length0: wp.array2d[float],
    eq_type: wp.array[int],
    eq_obj1id: wp.array[int],
    eq_obj2id: wp.array[int],
    eq_solref: wp.array2d[wp.vec2],
    eq_solimp: wp.array2d[vec5],
    eq_data: wp.array2d[vec12],
    # In:
    nefc_in: wp.array[int],
    type_in: wp.array2d[int],
    id_in: wp.array2d[int],
    jacobian_in: wp.array3d[float],
    pos_in: wp.array2d[float],
    margin_in: wp.array2d[float],
    force_in: wp.array2d[float],
    slope_in: wp.array2d[float],
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    qacc_in: wp.array2d[float],
    lam_in: wp.array2d[float],
    ten_J_in: wp.array2d[float],
    ten_length_in: wp.array2d[float],
    # Out:
    phi_qpos_out: wp.array2d[float],
    phi_qvel_out: wp.array2d[float],
    ten_length_bar_out: wp.array2d[float],
    ten_qvel_bar_out: wp.array2d[float],
    ten_lam_bar_out: wp.array2d[float],
    ten_qacc_bar_out: wp.array2d[float],
) -> None:
    """Φ ∋ -ρ(λ) f(ρ(a) + b ρ(v) + k imp pos) of every row that joints and tendons make; f also moves with D(pos)."""
    worldid, row = wp.tid()
    if row >= wp.min(nefc_in[worldid], slope_in.shape[1]):
        return
    kind = type_in[worldid, row]
    s = slope_in[worldid, row]
    f = force_in[worldid, row]
    if s == 0.0 and f == 0.0:
        return
    ident = id_in[worldid, row]
    solref = wp.vec2(0.0)
    solimp = vec5()
    if kind == ConstraintType.LIMIT_JOINT:
        solref = jnt_solref[worldid % jnt_solref.shape[0], ident]
        solimp = jnt_solimp[worldid % jnt_solimp.shape[0], ident]
    elif kind == ConstraintType.FRICTION_DOF:
        solref = dof_solref[worldid % dof_solref.shape[0], ident]
        solimp = dof_solimp[worldid % dof_solimp.shape[0], ident]
    elif kind == ConstraintType.LIMIT_TENDON:
        solref = tendon_solref_lim[worldid % tendon_solref_lim.shape[0], ident]
        solimp = tendon_solimp_lim[worldid % tendon_solimp_lim.shape[0], ident]
    elif kind == ConstraintType.FRICTION_TENDON:
        solref = tendon_solref_fri[worldid % tendon_solref_fri.shape[0], ident]
        solimp = tendon_solimp_fri[worldid % tendon_solimp_fri.shape[0], ident]
    elif kind == ConstraintType.EQUALITY:
        if eq_type[ident] != EqType.JOINT and eq_type[ident] != EqType.TENDON:
            return
        solref = eq_solref[worldid % eq_solref.shape[0], ident]
        solimp = eq_solimp[worldid % eq_solimp.shape[0], ident]
    else:
        return

    pos = pos_in[worldid, row] - margin_in[worldid, row]
    slopes = row_slopes(opt_disableflags, opt_timestep[worldid % opt_timestep.shape[0]], solref, solimp, pos)
    rate = float(0.0)
    for j in range(lam_in.shape[1]):
        rate += jacobian_in[worldid, row, j] * lam_in[worldid, j]
    # ∂Φ/∂jar = s ρ(λ) =: y
    y = s * rate
    vel_bar = slopes.damping * y
    pos_bar = slopes.stiffness * y - slopes.mass * rate * f
    bars = wp.vec4(pos_bar, vel_bar, -f, y)

    if kind == ConstraintType.FRICTION_DOF:
        add_joint_row(worldid, ident, 1.0, 0.0, vel_bar, phi_qpos_out, phi_qvel_out)
    elif kind == ConstraintType.LIMIT_JOINT:
        dof = jnt_dofadr[ident]
        if jnt_type[ident] == JointType.BALL:
            adr = jnt_qposadr[ident]
            turn = quat_angle_axis(
                wp.vec4(
                    qpos_in[worldid, adr],
                    qpos_in[worldid, adr + 1],
                    qpos_in[worldid, adr + 2],
                    qpos_in[worldid, adr + 3],
                )
            )
            axis = wp.vec3(turn[0], turn[1], turn[2])
            # ρ(x) = -axis·x ,  d(pos) = -axis·w ,  d(axis) = ½ cot(θ/2) w⊥ + ½ axis × w
            axis_bar = wp.vec3(0.0)
            for i in range(3):
                v = qvel_in[worldid, dof + i]
                a = qacc_in[worldid, dof + i]
                axis_bar[i] = -(bars[2] * lam_in[worldid, dof + i] + vel_bar * v + y * a)
            across = axis_bar - axis * wp.dot(axis, axis_bar)
            moved = -pos_bar * axis + 0.5 * wp.cross(axis_bar, axis)
            if turn[3] > 0.0:  # without a rotation there is no axis, and mujoco_warp's row is zero
                moved += 0.5 / wp.tan(0.5 * turn[3]) * across
            for i in range(3):
                wp.atomic_add(phi_qpos_out, worldid, dof + i, moved[i])
                wp.atomic_add(phi_qvel_out, worldid, dof + i, -vel_bar * axis[i])
        else:
            sign = jacobian_in[worldid, row, dof]
            add_joint_row(worldid, dof, sign, pos_bar, vel_bar, phi_qpos_out, phi_qvel_out)
    elif kind == ConstraintType.FRICTION_TENDON:
        bars[0] = 0.0
        add_tendon_row(
            worldid, ident, 1.0, bars, ten_length_bar_out, ten_qvel_bar_out, ten_lam_bar_out, ten_qacc_bar_out
        )
    elif kind == ConstraintType.LIMIT_TENDON:
        bounds = tendon_range[worldid % tendon_range.shape[0], ident]
        length = ten_length_in[worldid, ident]
        sign = wp.where(length - bounds[0] < bounds[1] - length, 1.0, -1.0)
        add_tendon_row(
            worldid, ident, sign, bars, ten_length_bar_out, ten_qvel_bar_out, ten_lam_bar_out, ten_qacc_bar_out
        )
    else:
        # pos = x₁ - p(x₂) ,  ρ(x) = ρ₁(x) - p' ρ₂(x) ,  d(p') = p'' dx₂
        first = eq_obj1id[ident]
        second = eq_obj2id[ident]
        data = eq_data[worldid % eq_data.shape[0], ident]
        x = float(0.0)
        if second >= 0:
            if eq_type[ident] == EqType.JOINT:
                adr = jnt_qposadr[second]
                x = qpos_in[worldid, adr] - qpos0[worldid % qpos0.shape[0], adr]
            else:
                x = ten_length_in[worldid, second] - tendon_length0[worldid % tendon_length0.shape[0], second]
        bend1 = data[1] + x * (2.0 * data[2] + x * (3.0 * data[3] + x * 4.0 * data[4]))
        bend2 = 2.0 * data[2] + x * (6.0 * data[3] + x * 12.0 * data[4])
        if eq_type[ident] == EqType.JOINT:
            add_joint_row(worldid, jnt_dofadr[first], 1.0, pos_bar, vel_bar, phi_qpos_out, phi_qvel_out)
            if second >= 0:
                dof = jnt_dofadr[second]
                mixed = bars[2] * lam_in[worldid, dof] + vel_bar * qvel_in[worldid, dof] + y * qacc_in[worldid, dof]
                add_joint_row(worldid, dof, -bend1, pos_bar, vel_bar, phi_qpos_out, phi_qvel_out)
                wp.atomic_add(phi_qpos_out, worldid, dof, -bend2 * mixed)
        else:
            add_tendon_row(
                worldid, first, 1.0, bars, ten_length_bar_out, ten_qvel_bar_out, ten_lam_bar_out, ten_qacc_bar_out
            )
            if second >= 0:
                nnz = ten_J_rownnz[second]
                adr = ten_J_rowadr[second]
                jac = ten_J_in[worldid]
                mixed = bars[2] * tendon_rate(nnz, adr, ten_J_colind, jac, lam_in[worldid])
                mixed += vel_bar * tendon_rate(nnz, adr, ten_J_colind, jac, qvel_in[worldid])
                mixed += y * tendon_rate(nnz, adr, ten_J_colind, jac, qacc_in[worldid])
                add_tendon_row(
                    worldid, second, -bend1, bars,
                    ten_length_bar_out, ten_qvel_bar_out, ten_lam_bar_out, ten_qacc_bar_out,
                )  # fmt: skip
                wp.atomic_add(ten_length_bar_out, worldid, second, -bend2 * mixed)
