"""Damping, armature and springs of joints: scalars of τ and of M's diagonal."""

import warp as wp
from mujoco_warp import JointType

from msk_ray.step.adjoint.groups import Joints, Multipliers, Springs, State, Substep
from msk_ray.step.adjoint.laws.joint_springs import log_rate_pullback, spring_slope
from msk_ray.step.adjoint.parameters.base import ParameterFamily
from msk_ray.step.adjoint.spatial import add_three, four, quat_gradient, three
from msk_ray.step.forward.mjw_private import poly_force_deriv, quat_sub

wp.set_module_options({"enable_backward": False})


@wp.struct
class JointGradients:
    """Gradients by dof (W, nv), by joint (W, njnt) and by coordinate (W, nq)."""

    dof_damping: wp.array2d[float]
    dof_armature: wp.array2d[float]
    jnt_stiffness: wp.array2d[float]
    qpos_spring: wp.array2d[float]


@wp.kernel
def pull_joints(
    # Model:
    opt_timestep: wp.array[float],
    spring_on: bool,
    damper_on: bool,
    implicit_damping: bool,
    joints: Joints,
    springs: Springs,
    # In:
    live_in: wp.array[int],
    state_in: State,
    multipliers_in: Multipliers,
    # Out:
    gradients_out: JointGradients,
) -> None:
    """Φ ∋ λ (k(x) x + c v) + λ A a - μ A (a - â), and h μ c â with implicit damping; x from the spring's rest."""
    worldid, jnt = wp.tid()
    if live_in[worldid] == 0:
        return
    kind = joints.jnt_type[jnt]
    q = joints.jnt_qposadr[jnt]
    v = joints.jnt_dofadr[jnt]
    count = int(1)
    if kind == JointType.FREE:
        count = int(6)
    elif kind == JointType.BALL:
        count = int(3)
    h = opt_timestep[worldid % opt_timestep.shape[0]]
    for i in range(count):
        j = v + i
        lam = multipliers_in.lam[worldid, j]
        mu = multipliers_in.mu[worldid, j]
        excess = multipliers_in.excess[worldid, j]
        acc = state_in.qacc[worldid, j]
        gradients_out.dof_armature[worldid, j] = gradients_out.dof_armature[worldid, j] - lam * acc + mu * excess
        if damper_on:
            slope = lam * state_in.qvel[worldid, j]
            if implicit_damping:
                slope += h * mu * (acc - excess)
            gradients_out.dof_damping[worldid, j] = gradients_out.dof_damping[worldid, j] - slope
    if not spring_on:
        return
    stiffness = springs.jnt_stiffness[worldid % springs.jnt_stiffness.shape[0], jnt]
    poly = springs.jnt_stiffnesspoly[worldid % springs.jnt_stiffnesspoly.shape[0], jnt]
    rest = worldid % springs.qpos_spring.shape[0]
    pull = float(0.0)
    if kind == JointType.HINGE or kind == JointType.SLIDE:
        stretch = state_in.qpos[worldid, q] - springs.qpos_spring[rest, q]
        pull = multipliers_in.lam[worldid, v] * stretch
        slope = multipliers_in.lam[worldid, v] * poly_force_deriv(stiffness, poly, stretch, 0)
        gradients_out.qpos_spring[worldid, q] = gradients_out.qpos_spring[worldid, q] + slope
    else:
        if kind == JointType.FREE:
            dif = three(state_in.qpos, worldid, q) - three(springs.qpos_spring, rest, q)
            lam_shift = three(multipliers_in.lam, worldid, v)
            pull = wp.dot(lam_shift, dif)
            add_three(gradients_out.qpos_spring, worldid, q, spring_slope(stiffness, poly, dif, lam_shift))
            q += 3
            v += 3
        now = four(state_in.qpos, worldid, q)
        still = four(springs.qpos_spring, rest, q)
        phi = quat_sub(wp.normalize(now), still)
        turn = three(multipliers_in.lam, worldid, v)
        pull += wp.dot(turn, phi)
        # log(exp(-w) exp(φ)) = φ - Jr(-φ)⁻¹ w
        back = log_rate_pullback(-phi, spring_slope(stiffness, poly, phi, turn))
        raw = quat_gradient(still, back)
        for i in range(4):
            gradients_out.qpos_spring[worldid, q + i] = gradients_out.qpos_spring[worldid, q + i] + raw[i]
    gradients_out.jnt_stiffness[worldid, jnt] = gradients_out.jnt_stiffness[worldid, jnt] - pull


class JointFamily(ParameterFamily):
    """Launches of the gradients of damping, armature and springs."""

    kinds = (JointGradients,)

    def launch(self, at: Substep) -> None:
        self.work.launch(pull_joints, (self.work.nworld, self.work.model.njnt), at, *self.gradients)
