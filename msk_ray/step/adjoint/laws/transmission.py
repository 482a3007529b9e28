"""Actuators whose moment m turns with q: at sites, and in the parent's frame of ball and free joints.

∂Φ/∂q ∋ Σ_x ∂Φ/∂ρ(x) ∂(m·x)/∂q ,  x = λ, v, μ, â ,  and ∂Φ/∂len ∂len/∂q where m is not ∂len/∂q .
"""

import warp as wp
from mujoco_warp import JointType, TrnType

from msk_ray.step.adjoint.groups import DofSlopes, FieldBars, Fields, Joints, Motion, Multipliers, State, Substep
from msk_ray.step.adjoint.laws.actuators import ActuatorBars
from msk_ray.step.adjoint.laws.joint_springs import log_rate_pullback
from msk_ray.step.adjoint.spatial import add_three, carried, four, point_velocity, three, wrench
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import quat_to_vel

wp.set_module_options({"enable_backward": False})


@wp.struct
class Transmissions:
    """What actuators act on."""

    actuator_trntype: wp.array[int]
    actuator_trnid: wp.array[wp.vec2i]
    actuator_gear: wp.array2d[wp.spatial_vector]


@wp.func
def weighted_dof(worldid: int, dof: int, rates: wp.vec4, state_in: State, multipliers_in: Multipliers) -> float:
    """Σ ρ̄(x) x of one dof, x = λ, v, μ, â."""
    smooth = state_in.qacc[worldid, dof] - multipliers_in.excess[worldid, dof]
    out = rates[0] * multipliers_in.lam[worldid, dof] + rates[1] * state_in.qvel[worldid, dof]
    return out + (rates[2] * multipliers_in.mu[worldid, dof] + rates[3] * smooth)


@wp.func
def weighted_twist(
    body: int, worldid: int, rates: wp.vec4, fields_in: Fields, cvel_in: wp.array2d[wp.spatial_vector]
) -> wp.spatial_vectorf:
    """Σ ρ̄(x) V(x) of one body."""
    smooth = fields_in.qacc[worldid, body] - fields_in.excess[worldid, body]
    out = rates[0] * fields_in.lam[worldid, body] + rates[1] * cvel_in[worldid, body]
    return out + rates[2] * fields_in.mu[worldid, body] + rates[3] * smooth


@wp.func
def push_load(
    body: int,
    worldid: int,
    rates: wp.vec4,
    load: wp.spatial_vectorf,
    total: wp.spatial_vectorf,
    moved: wp.spatial_vectorf,
    bars_out: FieldBars,
) -> None:
    """Adds a load on one body: ρ̄(x) on every field, and what carrying it along gives; `moved` is its pose's own."""
    if body > 0:
        wp.atomic_add(bars_out.lam, worldid, body, rates[0] * load)
        wp.atomic_add(bars_out.qvel, worldid, body, rates[1] * load)
        wp.atomic_add(bars_out.mu, worldid, body, rates[2] * load)
        # â = a - (a - â)
        wp.atomic_add(bars_out.qacc, worldid, body, rates[3] * load)
        wp.atomic_add(bars_out.excess, worldid, body, -rates[3] * load)
        wp.atomic_add(bars_out.moved, worldid, body, carried(total, load) + moved)


@wp.kernel
def pull_turning_joints(
    lanes: int,
    count: int,
    # Model:
    joints: Joints,
    transmissions: Transmissions,
    # In:
    state_in: State,
    multipliers_in: Multipliers,
    moment_rowadr_in: wp.array2d[int],
    actuator_moment_in: wp.array2d[float],
    actuator_bars_in: ActuatorBars,
    # Out:
    slopes_out: DofSlopes,
) -> None:
    """len = gear·log(q) of a ball joint; in the parent's frame the moment is m = R(q)ᵀ gear.

    `lanes` threads take all `count` actuators of a world in turn.
    """
    worldid, lane = wp.tid()
    for uid in range(lane, count, lanes):
        kind = transmissions.actuator_trntype[uid]
        if kind != TrnType.JOINT and kind != TrnType.JOINTINPARENT:
            continue
        jnt = transmissions.actuator_trnid[uid][0]
        joint = joints.jnt_type[jnt]
        if joint != JointType.BALL and joint != JointType.FREE:
            continue
        dof = joints.jnt_dofadr[jnt]
        first = moment_rowadr_in[worldid, uid]
        slope = wp.vec3(0.0)
        if joint == JointType.BALL:
            q = joints.jnt_qposadr[jnt]
            quat = four(state_in.qpos, worldid, q)
            phi = quat_to_vel(wp.normalize(quat))
            gear = wp.spatial_top(transmissions.actuator_gear[worldid % transmissions.actuator_gear.shape[0], uid])
            slope = actuator_bars_in.length[worldid, uid] * log_rate_pullback(phi, gear)
        else:
            dof += 3
            first += 3
        if kind == TrnType.JOINTINPARENT:
            bars = actuator_bars_in.rate[worldid, uid]
            moment = three(actuator_moment_in, worldid, first)
            x = wp.vec3(0.0)
            for i in range(3):
                x[i] = weighted_dof(worldid, dof + i, bars, state_in, multipliers_in)
            # m·x = gear·R x ,  d(R x) = R (w × x)
            slope += wp.cross(x, moment)
        add_three(slopes_out.qpos, worldid, dof, slope)


@wp.kernel
def pull_sites(
    lanes: int,
    count: int,
    # Model:
    body_rootid: wp.array[int],
    site_bodyid: wp.array[int],
    transmissions: Transmissions,
    # In:
    site_xpos_in: wp.array2d[wp.vec3],
    site_xmat_in: wp.array2d[wp.mat33],
    motion_in: Motion,
    actuator_bars_in: ActuatorBars,
    fields_in: Fields,
    # Out:
    bars_out: FieldBars,
) -> None:
    """m·x = F·u(x) + T·ω(x) at the site, with force F and torque T fixed in the site's frame; len = 0.

    `lanes` threads take all `count` actuators of a world in turn.
    """
    worldid, lane = wp.tid()
    for uid in range(lane, count, lanes):
        if transmissions.actuator_trntype[uid] != TrnType.SITE or transmissions.actuator_trnid[uid][1] >= 0:
            continue
        site = transmissions.actuator_trnid[uid][0]
        body = site_bodyid[site]
        if body == 0:
            continue
        gear = transmissions.actuator_gear[worldid % transmissions.actuator_gear.shape[0], uid]
        mat = site_xmat_in[worldid, site]
        force = mat @ wp.spatial_top(gear)
        torque = mat @ wp.spatial_bottom(gear)
        arm = site_xpos_in[worldid, site] - motion_in.subtree_com[worldid, body_rootid[body]]
        load = wrench(force, torque, arm)
        bars = actuator_bars_in.rate[worldid, uid]
        total = weighted_twist(body, worldid, bars, fields_in, motion_in.cvel)
        # The point moves (p̄ = F × ω), and F and T turn with the body: torques F × u and T × ω.
        spin = wp.spatial_top(total)
        turn = wp.cross(force, point_velocity(total, arm)) + wp.cross(torque, spin)
        push_load(body, worldid, bars, load, total, wrench(wp.cross(force, spin), turn, arm), bars_out)


def launch_transmissions(work: Workspace, bars: ActuatorBars, at: Substep) -> None:
    """Launch what the turning of moments gives ∂Φ, for such joints and for sites, as far as the model has them."""
    if work.tables.has_turning_transmission:
        work.launch_lanes(pull_turning_joints, work.model.nactuator, at, bars)
    if work.tables.has_site_transmission:
        work.launch_lanes(pull_sites, work.model.nactuator, at, bars)
