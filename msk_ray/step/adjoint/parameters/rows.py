"""Friction loss, limits and solver parameters of the rows that joints and tendons make."""

from typing import Any

import warp as wp
from mujoco_warp import DisableBit, JointType

from msk_ray.step.adjoint.groups import Joints, RowLaws, Rows, State, Substep, TendonRows
from msk_ray.step.adjoint.laws.impedance import row_slopes, stiffness_damping
from msk_ray.step.adjoint.laws.scalar_rows import RowSettings, foremost_rows, solver_parameters
from msk_ray.step.adjoint.laws.tendons import tendon_rate
from msk_ray.step.adjoint.parameters.base import ParameterStage, Parts, TimestepGradient
from msk_ray.step.adjoint.parameters.row_laws import FRICTION, ONE_SIDED, TWO_SIDED, RowMotion, row_score
from msk_ray.step.forward.mjw_private import ConstraintType, EqType, vec5

wp.set_module_options({"enable_backward": False})


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


@wp.struct
class RowRanges:
    """Limits of joints."""

    jnt_range: wp.array2d[wp.vec2]


@wp.struct
class Losses:
    """Friction loss of dofs and tendons."""

    dof_frictionloss: wp.array2d[float]
    tendon_frictionloss: wp.array2d[float]


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


@wp.kernel
def pull_row_parameters(
    # Model:
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    joints: Joints,
    settings: RowSettings,
    ranges: RowRanges,
    # In:
    count: int,
    lanes: int,
    live_in: wp.array[int],
    nefc_in: wp.array[int],
    rows_in: Rows,
    jacobian_in: wp.array3d[float],
    laws_in: RowLaws,
    state_in: State,
    lam_in: wp.array2d[float],
    ten_length_in: wp.array2d[float],
    # Out:
    gradients_out: RowGradients,
    timestep_out: TimestepGradient,
) -> None:
    """-Φ ∋ ρ(λ) f(jar): slopes by the parameters of the rows that are no contact's, `lanes` threads a world."""
    worldid, lane = wp.tid()
    if live_in[worldid] == 0:
        return
    for row in range(lane, wp.min(nefc_in[worldid], count), lanes):
        kind = rows_in.type[worldid, row]
        if laws_in.slope[worldid, row] == 0.0 and laws_in.force[worldid, row] == 0.0:
            continue
        ident = rows_in.id[worldid, row]
        motion = RowMotion()
        motion.law = ONE_SIDED
        solver = solver_parameters(worldid, kind, ident, settings)
        if not solver.known:
            continue
        solref = solver.solref
        solimp = solver.solimp
        shared = bool(False)
        if kind == ConstraintType.FRICTION_DOF or kind == ConstraintType.FRICTION_TENDON:
            motion.law = FRICTION
        elif kind == ConstraintType.EQUALITY:
            motion.law = TWO_SIDED
            # The rows of a connect or weld share one impedance.
            shared = settings.eq_type[ident] != EqType.JOINT and settings.eq_type[ident] != EqType.TENDON

        for j in range(lam_in.shape[1]):
            motion.lam += jacobian_in[worldid, row, j] * lam_in[worldid, j]
            motion.vel += jacobian_in[worldid, row, j] * state_in.qvel[worldid, j]
        timestep = opt_timestep[worldid % opt_timestep.shape[0]]
        aref = rows_in.aref[worldid, row]
        if shared:
            y = laws_in.slope[worldid, row] * motion.lam
            step = bounded_step_slope(opt_disableflags, timestep, solref, solimp[1], motion.vel, aref)
            wp.atomic_sub(timestep_out.timestep, worldid, y * step)
            continue
        pos = rows_in.pos[worldid, row] - rows_in.margin[worldid, row]
        slopes = row_slopes(opt_disableflags, timestep, solref, solimp, pos)
        motion.disableflags = opt_disableflags
        motion.weight = slopes.impedance / ((1.0 - slopes.impedance) * rows_in.D[worldid, row])
        motion.rest = laws_in.jar[worldid, row] - slopes.damping * motion.vel
        if motion.law != FRICTION:
            motion.rest -= slopes.spring * pos
        loss = rows_in.frictionloss[worldid, row]
        _m, solref_bar, solimp_bar, pos_bar, loss_bar, timestep_bar = wp.grad(row_score)(
            motion, solref, solimp, pos, loss, timestep
        )
        wp.atomic_add(timestep_out.timestep, worldid, timestep_bar)
        if kind == ConstraintType.LIMIT_JOINT:
            wp.atomic_add(gradients_out.jnt_solref, worldid, ident, solref_bar)
            wp.atomic_add(gradients_out.jnt_solimp, worldid, ident, solimp_bar)
            bounds = ranges.jnt_range[worldid % ranges.jnt_range.shape[0], ident]
            bar = wp.vec2(0.0)
            if joints.jnt_type[ident] == JointType.BALL:
                # pos = max(range) - angle
                if bounds[0] > bounds[1]:
                    bar[0] = pos_bar
                else:
                    bar[1] = pos_bar
            elif jacobian_in[worldid, row, joints.jnt_dofadr[ident]] > 0.0:
                # pos = q - lower, or upper - q
                bar[0] = -pos_bar
            else:
                bar[1] = pos_bar
            wp.atomic_add(gradients_out.jnt_range, worldid, ident, bar)
        elif kind == ConstraintType.FRICTION_DOF:
            wp.atomic_add(gradients_out.dof_solref, worldid, ident, solref_bar)
            wp.atomic_add(gradients_out.dof_solimp, worldid, ident, solimp_bar)
            wp.atomic_add(gradients_out.dof_frictionloss, worldid, ident, loss_bar)
        elif kind == ConstraintType.LIMIT_TENDON:
            wp.atomic_add(gradients_out.tendon_solref_lim, worldid, ident, solref_bar)
            wp.atomic_add(gradients_out.tendon_solimp_lim, worldid, ident, solimp_bar)
            reach = settings.tendon_range[worldid % settings.tendon_range.shape[0], ident]
            length = ten_length_in[worldid, ident]
            bar = wp.vec2(0.0, pos_bar)
            if length - reach[0] < reach[1] - length:
                bar = wp.vec2(-pos_bar, 0.0)
            wp.atomic_add(gradients_out.tendon_range, worldid, ident, bar)
        elif kind == ConstraintType.FRICTION_TENDON:
            wp.atomic_add(gradients_out.tendon_solref_fri, worldid, ident, solref_bar)
            wp.atomic_add(gradients_out.tendon_solimp_fri, worldid, ident, solimp_bar)
            wp.atomic_add(gradients_out.tendon_frictionloss, worldid, ident, loss_bar)


@wp.kernel
def pull_absent_friction(
    # Model:
    nv: int,
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    settings: RowSettings,
    losses: Losses,
    tendons: TendonRows,
    # In:
    count: int,
    lanes: int,
    live_in: wp.array[int],
    state_in: State,
    lam_in: wp.array2d[float],
    ten_J_in: wp.array2d[float],
    # Out:
    gradients_out: RowGradients,
) -> None:
    """A dof or tendon without friction loss has no row, but a slope: f = -loss sign(ρ(a) + b ρ(v)) for small ones."""
    worldid, lane = wp.tid()
    if live_in[worldid] == 0:
        return
    for place in range(lane, count, lanes):
        loss = float(0.0)
        lam = float(0.0)
        acc = float(0.0)
        vel = float(0.0)
        solref = wp.vec2(0.0)
        solimp = vec5()
        t = place - nv
        if t < 0:
            loss = losses.dof_frictionloss[worldid % losses.dof_frictionloss.shape[0], place]
            lam = lam_in[worldid, place]
            acc = state_in.qacc[worldid, place]
            vel = state_in.qvel[worldid, place]
            solref = settings.dof_solref[worldid % settings.dof_solref.shape[0], place]
            solimp = settings.dof_solimp[worldid % settings.dof_solimp.shape[0], place]
        else:
            loss = losses.tendon_frictionloss[worldid % losses.tendon_frictionloss.shape[0], t]
            lam = tendon_rate(tendons, t, ten_J_in[worldid], lam_in[worldid])
            acc = tendon_rate(tendons, t, ten_J_in[worldid], state_in.qacc[worldid])
            vel = tendon_rate(tendons, t, ten_J_in[worldid], state_in.qvel[worldid])
            solref = settings.tendon_solref_fri[worldid % settings.tendon_solref_fri.shape[0], t]
            solimp = settings.tendon_solimp_fri[worldid % settings.tendon_solimp_fri.shape[0], t]
        if loss > 0.0:
            continue
        timestep = opt_timestep[worldid % opt_timestep.shape[0]]
        jar = acc + stiffness_damping(opt_disableflags, timestep, solref, solimp[1])[1] * vel
        slope = float(0.0)
        if jar != 0.0:
            slope = -lam * wp.sign(jar)
        if t < 0:
            gradients_out.dof_frictionloss[worldid, place] = gradients_out.dof_frictionloss[worldid, place] + slope
        else:
            gradients_out.tendon_frictionloss[worldid, t] = gradients_out.tendon_frictionloss[worldid, t] + slope


class RowStage(ParameterStage):
    """Launches of the gradients of friction loss, limits and their solver parameters."""

    kinds = (RowGradients, TimestepGradient)

    def __init__(self, parts: Parts, gradients: dict[Any, Any]) -> None:
        super().__init__(parts, gradients)
        self._rows = foremost_rows(parts.work)

    def launch(self, at: Substep) -> None:
        work, m = self.work, self.work.model
        work.launch_lanes(pull_row_parameters, self._rows, at, *self.gradients, lam=work.multipliers.lam)
        work.launch_lanes(pull_absent_friction, m.nv + m.ntendon, at, *self.gradients, lam=work.multipliers.lam)
