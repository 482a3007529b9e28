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
from msk_ray.step.adjoint.laws.transmission import weighted_dof, weighted_twist
from msk_ray.step.adjoint.parameters.base import ParameterFamily
from msk_ray.step.adjoint.parameters.inertia import rotation
from msk_ray.step.adjoint.spatial import four, point_velocity
from msk_ray.step.adjoint.step import StepAdjoint
from msk_ray.step.forward.mjw_private import quat_to_vel

wp.set_module_options({"enable_backward": False})


@wp.struct
class GearGradients:
    """Gradients by actuator, (W, U)."""

    actuator_gear: wp.array2d[wp.spatial_vector]


@wp.func
def joint_rate(
    worldid: int,
    jnt: int,
    in_parent: bool,
    bars: wp.vec4,
    length_bar: float,
    joints: Joints,
    actuators: ActuatorSettings,
    drive_in: Drive,
    state_in: State,
    multipliers_in: Multipliers,
) -> wp.spatial_vectorf:
    """∂Φ by the gear of an actuator on a joint; at its actuator force limit a joint has no rate under λ."""
    out = wp.spatial_vectorf()
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
    for i in range(count):
        own = bars
        if is_held(worldid, dof + i, actuators, drive_in):
            own[0] = 0.0
        out[i] = weighted_dof(worldid, dof + i, own, state_in, multipliers_in)
    if turn < 0:
        out[0] += length_bar * state_in.qpos[worldid, q]
        return out
    quat = wp.normalize(four(state_in.qpos, worldid, q))
    x = wp.vec3(out[turn], out[turn + 1], out[turn + 2])
    if in_parent:
        x = rotation(quat) @ x
    if kind == JointType.BALL:
        x += length_bar * quat_to_vel(quat)
    for i in range(3):
        out[turn + i] = x[i]
    return out


@wp.func
def tendon_gear_rate(
    worldid: int,
    t: int,
    bars: wp.vec4,
    tendons: TendonRows,
    actuators: ActuatorSettings,
    drive_in: Drive,
    state_in: State,
    multipliers_in: Multipliers,
    ten_J_in: wp.array2d[float],
) -> float:
    """Rate of a tendon under Σ_x ρ̄(x) x, x = λ and v alone: κ holds the others."""
    rate = float(0.0)
    start = tendons.ten_J_rowadr[t]
    for k in range(start, start + tendons.ten_J_rownnz[t]):
        j = tendons.ten_J_colind[k]
        own = wp.vec4(bars[0], bars[1], 0.0, 0.0)
        if is_held(worldid, j, actuators, drive_in):
            own[0] = 0.0
        rate += ten_J_in[worldid, k] * weighted_dof(worldid, j, own, state_in, multipliers_in)
    return rate


@wp.kernel
def pull_gears(
    # Model:
    joints: Joints,
    tendons: TendonRows,
    actuators: ActuatorSettings,
    body_rootid: wp.array[int],
    site_bodyid: wp.array[int],
    # In:
    count: int,
    lanes: int,
    live_in: wp.array[int],
    bars_in: ActuatorBars,
    drive_in: Drive,
    site_xpos_in: wp.array2d[wp.vec3],
    site_xmat_in: wp.array2d[wp.mat33],
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
        bars = bars_in.rate[worldid, uid]
        length_bar = bars_in.length[worldid, uid]
        slope = wp.spatial_vectorf()
        if kind == TrnType.TENDON:
            slope[0] = length_bar * ten_length_in[worldid, target] + tendon_gear_rate(
                worldid, target, bars, tendons, actuators, drive_in, state_in, multipliers_in, ten_J_in
            )
            # κ counts pairs that M couples, and is quadratic in the one gear
            gear = actuators.actuator_gear[worldid % actuators.actuator_gear.shape[0], uid][0]
            if gear != 0.0:
                slope[0] -= 2.0 * bars_in.implicit[worldid, uid] / gear
        elif kind == TrnType.SITE:
            body = site_bodyid[target]
            centre = motion_in.subtree_com[worldid, body_rootid[body]]
            twist = weighted_twist(body, worldid, bars, fields_in, motion_in.cvel)
            back = wp.transpose(site_xmat_in[worldid, target])
            rate = back @ point_velocity(twist, site_xpos_in[worldid, target] - centre)
            slope = wp.spatial_vector(rate, back @ wp.spatial_top(twist))
        elif kind == TrnType.JOINT or kind == TrnType.JOINTINPARENT:  # a slider-crank's gear is no parameter
            in_parent = kind == TrnType.JOINTINPARENT
            slope = joint_rate(
                worldid, target, in_parent, bars, length_bar, joints, actuators, drive_in, state_in, multipliers_in
            )
        gradients_out.actuator_gear[worldid, uid] -= slope


class GearFamily(ParameterFamily):
    """Launches of the gradients of gears."""

    kinds = (GearGradients,)

    @classmethod
    def applies(cls, adjoint: StepAdjoint) -> bool:
        return adjoint.actuators is not None

    def launch(self, at: Substep) -> None:
        assert self.adjoint.actuators is not None  # `applies`
        bars = self.adjoint.actuators.bars
        self.work.launch_lanes(pull_gears, self.work.model.nactuator, at, bars, *self.gradients)
