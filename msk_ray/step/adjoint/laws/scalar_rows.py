"""The pullback of rows that constrain a joint or a tendon: limits, friction loss, and joint and tendon equalities."""

import math

import numpy as np
import warp as wp
from mujoco_warp import DisableBit, JointType

from msk_ray.step.adjoint.groups import (
    DofSlopes,
    Joints,
    RowLaws,
    Rows,
    State,
    Substep,
    TendonBars,
    TendonRows,
    TimestepGradient,
)
from msk_ray.step.adjoint.laws.impedance import impedance, stiffness_damping
from msk_ray.step.adjoint.laws.row_potential import RowMotion, row_potential
from msk_ray.step.adjoint.laws.tendons import tendon_rate
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.capacity import scalar_rows
from msk_ray.step.forward.mjw_private import ConstraintType, EqType, vec5, vec12

wp.set_module_options({"enable_backward": False})

_PI = wp.constant(math.pi)


@wp.func
def add_joint_row(worldid: int, dof: int, sign: float, pos_bar: float, vel_bar: float, slopes_out: DofSlopes) -> None:
    """A row with ρ(x) = sign·x_j and d(pos) = sign·dq_j."""
    wp.atomic_add(slopes_out.qpos, worldid, dof, sign * pos_bar)
    wp.atomic_add(slopes_out.qvel, worldid, dof, sign * vel_bar)


@wp.func
def add_tendon_row(worldid: int, t: int, sign: float, bars: wp.vec4, tendon_bars_out: TendonBars) -> None:
    """A row with ρ(x) = sign·J_t x and d(pos) = sign·dl; bars are cotangents of (pos, ρ(v), ρ(λ), ρ(a))."""
    wp.atomic_add(tendon_bars_out.length, worldid, t, sign * bars[0])
    wp.atomic_add(tendon_bars_out.qvel, worldid, t, sign * bars[1])
    wp.atomic_add(tendon_bars_out.lam, worldid, t, sign * bars[2])
    wp.atomic_add(tendon_bars_out.qacc, worldid, t, sign * bars[3])


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


@wp.struct
class RowSettings:
    """Parameters of the rows of joints, dofs, tendons and equalities."""

    qpos0: wp.array2d[float]
    jnt_range: wp.array2d[wp.vec2]
    jnt_solref: wp.array2d[wp.vec2]
    jnt_solimp: wp.array2d[vec5]
    dof_solref: wp.array2d[wp.vec2]
    dof_solimp: wp.array2d[vec5]
    tendon_solref_lim: wp.array2d[wp.vec2]
    tendon_solimp_lim: wp.array2d[vec5]
    tendon_solref_fri: wp.array2d[wp.vec2]
    tendon_solimp_fri: wp.array2d[vec5]
    tendon_range: wp.array2d[wp.vec2]
    tendon_length0: wp.array2d[float]
    eq_type: wp.array[int]
    eq_obj1id: wp.array[int]
    eq_obj2id: wp.array[int]
    eq_solref: wp.array2d[wp.vec2]
    eq_solimp: wp.array2d[vec5]
    eq_data: wp.array2d[vec12]


@wp.struct
class SolverParameters:
    """What sets a row's aref and D; `known` is false for rows of contacts."""

    known: bool
    solref: wp.vec2
    solimp: vec5


@wp.func
def solver_parameters(worldid: int, kind: int, ident: int, settings: RowSettings) -> SolverParameters:
    """Solver parameters of the limit, friction loss or equality `ident` that makes a row."""
    out = SolverParameters()
    out.known = True
    if kind == ConstraintType.LIMIT_JOINT:
        out.solref = settings.jnt_solref[worldid % settings.jnt_solref.shape[0], ident]
        out.solimp = settings.jnt_solimp[worldid % settings.jnt_solimp.shape[0], ident]
    elif kind == ConstraintType.FRICTION_DOF:
        out.solref = settings.dof_solref[worldid % settings.dof_solref.shape[0], ident]
        out.solimp = settings.dof_solimp[worldid % settings.dof_solimp.shape[0], ident]
    elif kind == ConstraintType.LIMIT_TENDON:
        out.solref = settings.tendon_solref_lim[worldid % settings.tendon_solref_lim.shape[0], ident]
        out.solimp = settings.tendon_solimp_lim[worldid % settings.tendon_solimp_lim.shape[0], ident]
    elif kind == ConstraintType.FRICTION_TENDON:
        out.solref = settings.tendon_solref_fri[worldid % settings.tendon_solref_fri.shape[0], ident]
        out.solimp = settings.tendon_solimp_fri[worldid % settings.tendon_solimp_fri.shape[0], ident]
    elif kind == ConstraintType.EQUALITY:
        out.solref = settings.eq_solref[worldid % settings.eq_solref.shape[0], ident]
        out.solimp = settings.eq_solimp[worldid % settings.eq_solimp.shape[0], ident]
    else:
        out.known = False
    return out


@wp.struct
class RowGradients:
    """Gradients by joint (W, njnt), dof (W, nv) and tendon (W, T)."""

    dof_frictionloss: wp.array2d[float]
    dof_solref: wp.array2d[wp.vec2]
    dof_solimp: wp.array2d[vec5]
    jnt_range: wp.array2d[wp.vec2]
    jnt_solref: wp.array2d[wp.vec2]
    jnt_solimp: wp.array2d[vec5]
    tendon_frictionloss: wp.array2d[float]
    tendon_solref_fri: wp.array2d[wp.vec2]
    tendon_solimp_fri: wp.array2d[vec5]
    tendon_range: wp.array2d[wp.vec2]
    tendon_solref_lim: wp.array2d[wp.vec2]
    tendon_solimp_lim: wp.array2d[vec5]


@wp.func
def add_row_gradients(
    worldid: int,
    kind: int,
    ident: int,
    bound: int,
    solref_bar: wp.vec2,
    solimp_bar: vec5,
    bound_bar: float,
    loss_bar: float,
    gradients_out: RowGradients,
) -> None:
    """Adds gradients of one row's solver parameters, and of its friction loss or of bound 0 or 1 of its limit."""
    range_bar = wp.vec2(0.0)
    range_bar[bound] = bound_bar
    if kind == ConstraintType.LIMIT_JOINT:
        wp.atomic_add(gradients_out.jnt_solref, worldid, ident, solref_bar)
        wp.atomic_add(gradients_out.jnt_solimp, worldid, ident, solimp_bar)
        wp.atomic_add(gradients_out.jnt_range, worldid, ident, range_bar)
    elif kind == ConstraintType.FRICTION_DOF:
        wp.atomic_add(gradients_out.dof_solref, worldid, ident, solref_bar)
        wp.atomic_add(gradients_out.dof_solimp, worldid, ident, solimp_bar)
        wp.atomic_add(gradients_out.dof_frictionloss, worldid, ident, loss_bar)
    elif kind == ConstraintType.LIMIT_TENDON:
        wp.atomic_add(gradients_out.tendon_solref_lim, worldid, ident, solref_bar)
        wp.atomic_add(gradients_out.tendon_solimp_lim, worldid, ident, solimp_bar)
        wp.atomic_add(gradients_out.tendon_range, worldid, ident, range_bar)
    elif kind == ConstraintType.FRICTION_TENDON:
        wp.atomic_add(gradients_out.tendon_solref_fri, worldid, ident, solref_bar)
        wp.atomic_add(gradients_out.tendon_solimp_fri, worldid, ident, solimp_bar)
        wp.atomic_add(gradients_out.tendon_frictionloss, worldid, ident, loss_bar)


@wp.func
def bounded_step_slope(
    disableflags: int, timestep: float, solref: wp.vec2, dmax: float, vel: float, aref: float
) -> float:
    """∂jar/∂h of a row, from its aref = -b ρ(v) - k imp pos: the time constant is held above 2 h."""
    if disableflags & DisableBit.REFSAFE or solref[0] <= 0.0 or solref[0] > 2.0 * timestep:
        return 0.0
    damping = stiffness_damping(disableflags, timestep, solref, dmax)[1]
    # b ∝ 1/h and k ∝ 1/h²
    slope = 2.0 * (aref + damping * vel) / timestep
    if solref[1] > 0.0:
        slope -= damping * vel / timestep
    return slope


@wp.func
def coefficient_bar(bars: wp.vec4, lam: float, vel: float, acc: float) -> float:
    """Cotangent of a coefficient c of ρ(x) = c x + ..., from x under λ, v and a; bars as for `add_tendon_row`."""
    return bars[2] * lam + bars[1] * vel + bars[3] * acc


@wp.func
def pull_ball_limit(
    worldid: int, dof: int, adr: int, bars: wp.vec4, state_in: State, lam_in: wp.array2d[float], slopes_out: DofSlopes
) -> None:
    """pos = max(range) - angle ,  ρ(x) = -axis·x ,  d(pos) = -axis·w ,  d(axis) = ½ cot(θ/2) w⊥ + ½ axis × w."""
    q = state_in.qpos[worldid]
    turn = quat_angle_axis(wp.vec4(q[adr], q[adr + 1], q[adr + 2], q[adr + 3]))
    axis = wp.vec3(turn[0], turn[1], turn[2])
    axis_bar = wp.vec3(0.0)
    for i in range(3):
        j = dof + i
        axis_bar[i] = -coefficient_bar(bars, lam_in[worldid, j], state_in.qvel[worldid, j], state_in.qacc[worldid, j])
    across = axis_bar - axis * wp.dot(axis, axis_bar)
    moved = -bars[0] * axis + 0.5 * wp.cross(axis_bar, axis)
    if turn[3] > 0.0:  # without a rotation there is no axis, and mujoco_warp's row is zero
        moved += 0.5 / wp.tan(0.5 * turn[3]) * across
    for i in range(3):
        wp.atomic_add(slopes_out.qpos, worldid, dof + i, moved[i])
        wp.atomic_add(slopes_out.qvel, worldid, dof + i, -bars[1] * axis[i])


@wp.func
def bends(data: vec12, x: float) -> wp.vec2:
    """p'(x) and p''(x) of an equality's polynomial."""
    bend1 = data[1] + x * (2.0 * data[2] + x * (3.0 * data[3] + x * 4.0 * data[4]))
    bend2 = 2.0 * data[2] + x * (6.0 * data[3] + x * 12.0 * data[4])
    return wp.vec2(bend1, bend2)


@wp.func
def pull_joint_equality(
    worldid: int,
    ident: int,
    joints: Joints,
    settings: RowSettings,
    bars: wp.vec4,
    state_in: State,
    lam_in: wp.array2d[float],
    slopes_out: DofSlopes,
) -> None:
    """pos = x₁ - p(x₂) ,  ρ(x) = ρ₁(x) - p' ρ₂(x) ,  d(p') = p'' dx₂, for two joints or one."""
    add_joint_row(worldid, joints.jnt_dofadr[settings.eq_obj1id[ident]], 1.0, bars[0], bars[1], slopes_out)
    second = settings.eq_obj2id[ident]
    if second >= 0:
        adr = joints.jnt_qposadr[second]
        x = state_in.qpos[worldid, adr] - settings.qpos0[worldid % settings.qpos0.shape[0], adr]
        bend = bends(settings.eq_data[worldid % settings.eq_data.shape[0], ident], x)
        dof = joints.jnt_dofadr[second]
        bar = coefficient_bar(bars, lam_in[worldid, dof], state_in.qvel[worldid, dof], state_in.qacc[worldid, dof])
        add_joint_row(worldid, dof, -bend[0], bars[0], bars[1], slopes_out)
        wp.atomic_add(slopes_out.qpos, worldid, dof, -bend[1] * bar)


@wp.func
def pull_tendon_equality(
    worldid: int,
    ident: int,
    tendons: TendonRows,
    settings: RowSettings,
    bars: wp.vec4,
    state_in: State,
    lam_in: wp.array2d[float],
    ten_J_in: wp.array2d[float],
    ten_length_in: wp.array2d[float],
    tendon_bars_out: TendonBars,
) -> None:
    """The same for two tendons or one."""
    add_tendon_row(worldid, settings.eq_obj1id[ident], 1.0, bars, tendon_bars_out)
    second = settings.eq_obj2id[ident]
    if second >= 0:
        rest = settings.tendon_length0[worldid % settings.tendon_length0.shape[0], second]
        x = ten_length_in[worldid, second] - rest
        bend = bends(settings.eq_data[worldid % settings.eq_data.shape[0], ident], x)
        jac = ten_J_in[worldid]
        lam = tendon_rate(tendons, second, jac, lam_in[worldid])
        vel = tendon_rate(tendons, second, jac, state_in.qvel[worldid])
        acc = tendon_rate(tendons, second, jac, state_in.qacc[worldid])
        add_tendon_row(worldid, second, -bend[0], bars, tendon_bars_out)
        wp.atomic_add(tendon_bars_out.length, worldid, second, -bend[1] * coefficient_bar(bars, lam, vel, acc))


@wp.kernel
def pull_rows(
    lanes: int,
    count: int,
    # Model:
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    joints: Joints,
    tendons: TendonRows,
    settings: RowSettings,
    # In:
    live_in: wp.array[int],
    nefc_in: wp.array[int],
    rows_in: Rows,
    jacobian_in: wp.array3d[float],
    laws_in: RowLaws,
    state_in: State,
    lam_in: wp.array2d[float],
    ten_J_in: wp.array2d[float],
    ten_length_in: wp.array2d[float],
    # Out:
    slopes_out: DofSlopes,
    tendon_bars_out: TendonBars,
    gradients_out: RowGradients,
    timestep_out: TimestepGradient,
) -> None:
    """Φ ∋ -ρ(λ) f(ρ(a) + b ρ(v) + k imp pos) of every row that joints and tendons make, with its parameters' gradients.

    f also moves with D(pos). Rows of connects and welds, which share one impedance, give the time step alone.

    `lanes` threads take the first `count` rows of a world in turn.
    """
    worldid, lane = wp.tid()
    for row in range(lane, count, lanes):
        if row >= wp.min(nefc_in[worldid], laws_in.slope.shape[1]):
            continue
        kind = rows_in.type[worldid, row]
        s = laws_in.slope[worldid, row]
        f = laws_in.force[worldid, row]
        if s == 0.0 and f == 0.0:
            continue
        ident = rows_in.id[worldid, row]
        solver = solver_parameters(worldid, kind, ident, settings)
        if not solver.known:
            continue
        timestep = opt_timestep[worldid % opt_timestep.shape[0]]
        keeps_step = live_in[worldid] != 0 and timestep_out.timestep.shape[0] > 0
        motion = RowMotion()
        for j in range(lam_in.shape[1]):
            motion.lam += jacobian_in[worldid, row, j] * lam_in[worldid, j]
            motion.vel += jacobian_in[worldid, row, j] * state_in.qvel[worldid, j]
        if kind == ConstraintType.EQUALITY:
            if settings.eq_type[ident] != EqType.JOINT and settings.eq_type[ident] != EqType.TENDON:
                if keeps_step:
                    aref = rows_in.aref[worldid, row]
                    step = bounded_step_slope(
                        opt_disableflags, timestep, solver.solref, solver.solimp[1], motion.vel, aref
                    )
                    wp.atomic_sub(timestep_out.timestep, worldid, s * motion.lam * step)
                continue

        pos = rows_in.pos[worldid, row] - rows_in.margin[worldid, row]
        kb = stiffness_damping(opt_disableflags, timestep, solver.solref, solver.solimp[1])
        imp = impedance(solver.solimp, pos)
        motion.disableflags = opt_disableflags
        motion.weight = imp / ((1.0 - imp) * rows_in.D[worldid, row])
        motion.rest = laws_in.jar[worldid, row] - kb[1] * motion.vel - kb[0] * imp * pos
        if s == 0.0:
            motion.held = wp.sign(f)
        loss = rows_in.frictionloss[worldid, row]
        motion_bar, solref_bar, solimp_bar, away_bar, loss_bar, step_bar = wp.grad(row_potential)(
            motion, solver.solref, solver.solimp, pos, loss, timestep
        )
        # The potential is -Φ, and ∂Φ/∂jar = s ρ(λ) is the cotangent of ρ(a).
        bars = wp.vec4(-away_bar, -motion_bar.vel, -f, -motion_bar.rest)
        bound = int(0)
        is_ball = bool(False)
        if kind == ConstraintType.FRICTION_DOF:
            add_joint_row(worldid, ident, 1.0, 0.0, bars[1], slopes_out)
        elif kind == ConstraintType.LIMIT_JOINT:
            dof = joints.jnt_dofadr[ident]
            if joints.jnt_type[ident] == JointType.BALL:
                is_ball = True
                bounds = settings.jnt_range[worldid % settings.jnt_range.shape[0], ident]
                bound = wp.where(bounds[0] > bounds[1], 0, 1)
                pull_ball_limit(worldid, dof, joints.jnt_qposadr[ident], bars, state_in, lam_in, slopes_out)
            else:
                sign = jacobian_in[worldid, row, dof]
                bound = wp.where(sign > 0.0, 0, 1)
                add_joint_row(worldid, dof, sign, bars[0], bars[1], slopes_out)
        elif kind == ConstraintType.FRICTION_TENDON:
            bars[0] = 0.0
            add_tendon_row(worldid, ident, 1.0, bars, tendon_bars_out)
        elif kind == ConstraintType.LIMIT_TENDON:
            bounds = settings.tendon_range[worldid % settings.tendon_range.shape[0], ident]
            length = ten_length_in[worldid, ident]
            bound = wp.where(length - bounds[0] < bounds[1] - length, 0, 1)
            add_tendon_row(worldid, ident, wp.where(bound == 0, 1.0, -1.0), bars, tendon_bars_out)
        elif settings.eq_type[ident] == EqType.JOINT:
            pull_joint_equality(worldid, ident, joints, settings, bars, state_in, lam_in, slopes_out)
        else:
            pull_tendon_equality(
                worldid, ident, tendons, settings, bars, state_in, lam_in, ten_J_in, ten_length_in, tendon_bars_out
            )
        if keeps_step:
            wp.atomic_add(timestep_out.timestep, worldid, step_bar)
        if live_in[worldid] != 0 and gradients_out.jnt_range.shape[0] > 0:
            # pos = q - lower, or upper - q
            bound_bar = wp.where(bound == 0 and not is_ball, -away_bar, away_bar)
            add_row_gradients(worldid, kind, ident, bound, solref_bar, solimp_bar, bound_bar, loss_bar, gradients_out)


def foremost_rows(work: Workspace) -> int:
    """How many rows may not be contacts'; those of contacts come after them."""
    return min(scalar_rows(work.mjm), work.njmax)


def launch_scalar_rows(work: Workspace, at: Substep) -> None:
    """Launch what the rows of joints, tendons and their equalities give ∂Φ, as far as the model has them."""
    mjm = work.mjm
    # Limits of joints alone are rows of different dofs.
    meet = bool(mjm.neq or mjm.ntendon or np.any(mjm.dof_frictionloss)) or at.wants(TimestepGradient)
    if work.tables.has_scalar_rows or at.wants(TimestepGradient):
        gradients = (at.gradient(RowGradients), at.gradient(TimestepGradient))
        work.launch_lanes(pull_rows, foremost_rows(work), at, *gradients, meet=meet, lam=work.multipliers.lam)
