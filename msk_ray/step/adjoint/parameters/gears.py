"""Gears of actuators; the parameters of gain, bias and activation are in `laws.actuators`.

A gear g enters through the length and its rates, which are linear in it:

    ḡ = -(∂Φ/∂len · len/g + Σ_x ∂Φ/∂ρ(x) · ρ(x)/g) ,  x = λ, v, μ, â .
"""

import warp as wp
from mujoco_warp import JointType, TrnType

from msk_ray.step.adjoint.groups import (
    Fields,
    Joints,
    Motion,
    Multipliers,
    State,
    Substep,
    TendonRows,
)
from msk_ray.step.adjoint.laws.actuators import (
    ActuatorBars,
    ActuatorSettings,
    Drive,
    is_held,
)
from msk_ray.step.adjoint.parameters.base import ParameterStage
from msk_ray.step.adjoint.parameters.inertia import rotation
from msk_ray.step.adjoint.spatial import four, point_velocity
from msk_ray.step.adjoint.step import StepAdjoint
from msk_ray.step.forward.mjw_private import quat_to_vel

wp.set_module_options({"enable_backward": False})


@wp.struct
class GearGradients:
    """Gradients by actuator, (W, U)."""

    actuator_gear: wp.array2d[wp.spatial_vector]


@wp.struct
class Levers:
    """Sites that actuators act on."""

    body_rootid: wp.array[int]
    site_bodyid: wp.array[int]
    site_xpos: wp.array2d[wp.vec3]
    site_xmat: wp.array2d[wp.mat33]


@wp.struct
class GearRates:
    """An actuator's length and its rates under λ, v, μ and â, each by component of its gear."""

    length: wp.spatial_vectorf
    lam: wp.spatial_vectorf
    vel: wp.spatial_vectorf
    mu: wp.spatial_vectorf
    smooth: wp.spatial_vectorf


@wp.func
def gear_rates_of_joint(
    worldid: int,
    jnt: int,
    in_parent: bool,
    joints: Joints,
    actuators: ActuatorSettings,
    drive_in: Drive,
    state_in: State,
    multipliers_in: Multipliers,
) -> GearRates:
    """Rates of an actuator on a joint; a joint at its actuator force limit has none under λ."""
    out = GearRates()
    kind = joints.jnt_type[jnt]
    dof = joints.jnt_dofadr[jnt]
    q = joints.jnt_qposadr[jnt]
    count = int(1)
    turn = int(-1)
    if kind == JointType.BALL:
        count = int(3)
        turn = int(0)
    elif kind == JointType.FREE:
        count = int(6)
        turn = int(3)
        q += 3
    else:
        out.length[0] = state_in.qpos[worldid, q]
    for i in range(count):
        j = dof + i
        if not is_held(worldid, j, actuators, drive_in):
            out.lam[i] = multipliers_in.lam[worldid, j]
        out.vel[i] = state_in.qvel[worldid, j]
        out.mu[i] = multipliers_in.mu[worldid, j]
        out.smooth[i] = state_in.qacc[worldid, j] - multipliers_in.excess[worldid, j]
    if turn >= 0:
        quat = wp.normalize(four(state_in.qpos, worldid, q))
        if kind == JointType.BALL:
            phi = quat_to_vel(quat)
            for i in range(3):
                out.length[i] = phi[i]
        if in_parent:
            mat = rotation(quat)
            lam = mat @ wp.vec3(out.lam[turn], out.lam[turn + 1], out.lam[turn + 2])
            vel = mat @ wp.vec3(out.vel[turn], out.vel[turn + 1], out.vel[turn + 2])
            mu = mat @ wp.vec3(out.mu[turn], out.mu[turn + 1], out.mu[turn + 2])
            smooth = mat @ wp.vec3(out.smooth[turn], out.smooth[turn + 1], out.smooth[turn + 2])
            for i in range(3):
                out.lam[turn + i] = lam[i]
                out.vel[turn + i] = vel[i]
                out.mu[turn + i] = mu[i]
                out.smooth[turn + i] = smooth[i]
    return out


@wp.func
def gear_rates_of_tendon(
    worldid: int,
    t: int,
    tendons: TendonRows,
    actuators: ActuatorSettings,
    drive_in: Drive,
    state_in: State,
    multipliers_in: Multipliers,
    ten_J_in: wp.array2d[float],
    ten_length_in: wp.array2d[float],
) -> GearRates:
    """Rates of an actuator on a tendon."""
    out = GearRates()
    out.length[0] = ten_length_in[worldid, t]
    start = tendons.ten_J_rowadr[t]
    for k in range(start, start + tendons.ten_J_rownnz[t]):
        j = tendons.ten_J_colind[k]
        lever = ten_J_in[worldid, k]
        if not is_held(worldid, j, actuators, drive_in):
            out.lam[0] += lever * multipliers_in.lam[worldid, j]
        out.vel[0] += lever * state_in.qvel[worldid, j]
        out.mu[0] += lever * multipliers_in.mu[worldid, j]
        out.smooth[0] += lever * (state_in.qacc[worldid, j] - multipliers_in.excess[worldid, j])
    return out


@wp.func
def site_rate(mat: wp.mat33, twist: wp.spatial_vectorf, arm: wp.vec3) -> wp.spatial_vectorf:
    """Velocity and spin of a site in its own frame."""
    turned = wp.transpose(mat)
    return wp.spatial_vector(turned @ point_velocity(twist, arm), turned @ wp.spatial_top(twist))


@wp.func
def gear_rates_of_site(worldid: int, site: int, levers: Levers, motion_in: Motion, fields_in: Fields) -> GearRates:
    """Rates of an actuator on a site, whose length is zero."""
    out = GearRates()
    body = levers.site_bodyid[site]
    mat = levers.site_xmat[worldid, site]
    arm = levers.site_xpos[worldid, site] - motion_in.subtree_com[worldid, levers.body_rootid[body]]
    out.lam = site_rate(mat, fields_in.lam[worldid, body], arm)
    out.vel = site_rate(mat, motion_in.cvel[worldid, body], arm)
    out.mu = site_rate(mat, fields_in.mu[worldid, body], arm)
    out.smooth = site_rate(mat, fields_in.qacc[worldid, body] - fields_in.excess[worldid, body], arm)
    return out


@wp.kernel
def pull_gears(
    # Model:
    joints: Joints,
    tendons: TendonRows,
    actuators: ActuatorSettings,
    # In:
    count: int,
    lanes: int,
    live_in: wp.array[int],
    bars_in: ActuatorBars,
    drive_in: Drive,
    levers_in: Levers,
    state_in: State,
    motion_in: Motion,
    multipliers_in: Multipliers,
    fields_in: Fields,
    ten_J_in: wp.array2d[float],
    ten_length_in: wp.array2d[float],
    # Out:
    gradients_out: GearGradients,
) -> None:
    """θ̄ -= ∂Φ/∂θ of gears, through length and rates."""
    worldid, lane = wp.tid()
    if live_in[worldid] == 0:
        return
    for uid in range(lane, count, lanes):
        kind = actuators.actuator_trntype[uid]
        target = actuators.actuator_trnid[uid][0]
        rates = GearRates()
        if kind == TrnType.TENDON:
            rates = gear_rates_of_tendon(
                worldid, target, tendons, actuators, drive_in, state_in, multipliers_in, ten_J_in, ten_length_in
            )
        elif kind == TrnType.SITE:
            rates = gear_rates_of_site(worldid, target, levers_in, motion_in, fields_in)
        elif kind == TrnType.JOINT or kind == TrnType.JOINTINPARENT:  # a slider-crank's gear is no parameter
            rates = gear_rates_of_joint(
                worldid,
                target,
                kind == TrnType.JOINTINPARENT,
                joints,
                actuators,
                drive_in,
                state_in,
                multipliers_in,
            )
        bar = bars_in.rate[worldid, uid]
        gear_bar = -(bar[0] * rates.lam + bar[1] * rates.vel + bars_in.length[worldid, uid] * rates.length)
        if kind == TrnType.TENDON:
            # κ counts pairs that M couples, and is quadratic in the one gear
            gear = actuators.actuator_gear[worldid % actuators.actuator_gear.shape[0], uid][0]
            if gear != 0.0:
                gear_bar[0] += 2.0 * bars_in.implicit[worldid, uid] / gear
        else:
            gear_bar -= bar[2] * rates.mu + bar[3] * rates.smooth
        gradients_out.actuator_gear[worldid, uid] += gear_bar


class GearStage(ParameterStage):
    """Launches of the gradients of gears."""

    kinds = (GearGradients,)

    @classmethod
    def applies(cls, adjoint: StepAdjoint) -> bool:
        return adjoint.actuators is not None

    def launch(self, at: Substep) -> None:
        assert self.adjoint.actuators is not None  # `applies`
        bars = self.adjoint.actuators.bars
        self.work.launch_lanes(pull_gears, self.work.model.nactuator, at, bars, *self.gradients)
