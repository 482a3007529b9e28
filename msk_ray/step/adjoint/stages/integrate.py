"""Pullback of q' = q ⊕ h v', and the two changes of coordinates between raw and tangent gradients.

Rotations are perturbed on the right (body frame), as MuJoCo's ball and free joint velocities are.
"""

import warp as wp
from mujoco_warp import JointType

from msk_ray.step.adjoint.groups import DofSlopes, Joints, Substep
from msk_ray.step.adjoint.spatial import set_three, three
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import dof_damping_total, poly_force_deriv

wp.set_module_options({"enable_backward": False})

UNIT_ROUNDING = wp.constant(1.0e-6)
"""A quaternion whose squared length differs from 1 by no more is one of unit length in float32."""


@wp.func
def rotation_pullback(phi: wp.vec3, g: wp.vec3) -> wp.vec3:
    """Exp(φ) g: (exp(-φ) exp(δ) exp(φ)) is exp(Exp(φ)ᵀ δ), so the cotangent of δ is Exp(φ) g."""
    square = wp.dot(phi, phi)
    a = 1.0 - square / 6.0
    b = 0.5 - square / 24.0
    if square > 1.0e-4:
        angle = wp.sqrt(square)
        half = wp.sin(0.5 * angle)
        a = wp.sin(angle) / angle
        b = 2.0 * half * half / square
    c = wp.cross(phi, g)
    return g + a * c + b * wp.cross(phi, c)


@wp.func
def rate_pullback(phi: wp.vec3, g: wp.vec3) -> wp.vec3:
    """Jr(φ)ᵀ g, with exp(φ + dφ) = exp(φ) exp(Jr dφ) and Jrᵀ = 1 + b[φ] + c[φ]²."""
    square = wp.dot(phi, phi)
    b = 0.5 - square / 24.0
    c = 1.0 / 6.0 - square / 120.0
    if square > 1.0e-2:
        angle = wp.sqrt(square)
        half = wp.sin(0.5 * angle)
        b = 2.0 * half * half / square
        c = (angle - wp.sin(angle)) / (square * angle)
    cr = wp.cross(phi, g)
    return g + b * cr + c * wp.cross(phi, cr)


@wp.struct
class DofDampers:
    """Linear and higher-order damping of dofs, that of actuators included."""

    jnt_actuatorid: wp.array[int]
    dof_jntid: wp.array[int]
    dof_damping: wp.array2d[float]
    dof_dampingpoly: wp.array2d[wp.vec2]
    actuator_trntype: wp.array[int]
    actuator_trnid: wp.array[wp.vec2i]
    actuator_damping: wp.array2d[float]
    actuator_dampingpoly: wp.array2d[wp.vec2]
    actuator_gear: wp.array2d[wp.spatial_vector]


@wp.kernel
def pull_position(
    # Model:
    opt_timestep: wp.array[float],
    joints: Joints,
    dampers: DofDampers,
    euler_damping: bool,
    # In:
    qvel_in: wp.array2d[float],
    qvel_next_in: wp.array2d[float],
    # Out:
    damping_out: wp.array2d[wp.vec3],
    damping_step_out: wp.array2d[float],
    grad_qpos_out: wp.array2d[float],
    grad_qvel_out: wp.array2d[float],
    rhs_out: wp.array2d[float],
    slopes_out: DofSlopes,
) -> None:
    """Turns cotangents of (q', v') into those of (q, v') in place, and starts this substep's sums.

    Also writes each dof's damping coefficients (c₀, c₁, c₂) of the force -v (c₀ + c₁|v| + c₂ v²), and hB.
    """
    worldid, jntid = wp.tid()
    h = opt_timestep[worldid % opt_timestep.shape[0]]
    kind = joints.jnt_type[jntid]
    dof = joints.jnt_dofadr[jntid]
    count = int(1)
    turn = dof
    if kind == JointType.FREE:
        count = int(6)
        turn = dof + 3
    elif kind == JointType.BALL:
        count = int(3)
    if kind == JointType.FREE or kind == JointType.BALL:
        g = three(grad_qpos_out, worldid, turn)
        phi = h * three(qvel_next_in, worldid, turn)
        # R' = R Exp(hω')  ⇒  δ̄ = Exp(hω') δ̄' ,  ω̄' += h Jr(hω')ᵀ δ̄'
        back = rotation_pullback(phi, g)
        rate = rate_pullback(phi, g)
        for i in range(3):
            grad_qpos_out[worldid, turn + i] = back[i]
            grad_qvel_out[worldid, turn + i] += h * rate[i]
    for i in range(count):
        j = dof + i
        # q' = q + h v'  ⇒  v̄' += h q̄'
        if kind == JointType.HINGE or kind == JointType.SLIDE or (kind == JointType.FREE and i < 3):
            grad_qvel_out[worldid, j] += h * grad_qpos_out[worldid, j]
        # v' = v + h (M + hB)⁻¹ M a: the right-hand side of (M + hB) μ = h v̄'
        rhs_out[worldid, j] = h * grad_qvel_out[worldid, j]
        linear, poly = dof_damping_total(
            dampers.jnt_actuatorid,
            dampers.dof_jntid,
            dampers.dof_damping,
            dampers.dof_dampingpoly,
            dampers.actuator_trntype,
            dampers.actuator_trnid,
            dampers.actuator_damping,
            dampers.actuator_dampingpoly,
            dampers.actuator_gear,
            worldid,
            j,
        )
        damping_out[worldid, j] = wp.vec3(linear, poly[0], poly[1])
        # hB = h d(c(|v|) v)/dv, the damping that the Euler integrator treats implicitly
        damping_step_out[worldid, j] = 0.0
        if euler_damping:
            damping_step_out[worldid, j] = h * poly_force_deriv(linear, poly, qvel_in[worldid, j], 1)
        slopes_out.qpos[worldid, j] = 0.0
        slopes_out.qvel[worldid, j] = 0.0


@wp.kernel
def project(
    # Model:
    joints: Joints,
    # In:
    qpos_in: wp.array2d[float],
    raw_in: wp.array2d[float],
    # Out:
    tangent_out: wp.array2d[float],
) -> None:
    """Raw gradient (W, nq) to tangent gradient (W, nv): the vector part of ½ q*⊗g for a quaternion."""
    worldid, jntid = wp.tid()
    kind = joints.jnt_type[jntid]
    q = joints.jnt_qposadr[jntid]
    v = joints.jnt_dofadr[jntid]
    if kind == JointType.FREE:
        set_three(tangent_out, worldid, v, three(raw_in, worldid, q))
        q += 3
        v += 3
    if kind == JointType.FREE or kind == JointType.BALL:
        w = qpos_in[worldid, q]
        u = three(qpos_in, worldid, q + 1)
        gw = raw_in[worldid, q]
        gu = three(raw_in, worldid, q + 1)
        # d(q⊗exp δ)/dδ at 0 is ½ q⊗[0, ·]  ⇒  δ̄ = ½ (w ḡ - ḡ_w u - u × ḡ)
        g = 0.5 * (w * gu - gw * u - wp.cross(u, gu))
        set_three(tangent_out, worldid, v, g)
    else:
        tangent_out[worldid, v] = raw_in[worldid, q]


@wp.kernel
def lift(
    # Model:
    joints: Joints,
    # In:
    qpos_in: wp.array2d[float],
    tangent_in: wp.array2d[float],
    # Out:
    raw_out: wp.array2d[float],
) -> None:
    """Tangent gradient (W, nv) to the raw one (W, nq) without a component along q: 2 q⊗[0, g] / |q|².

    A step normalises quaternions, so that its gradient gets the smaller the longer they are.
    """
    worldid, jntid = wp.tid()
    kind = joints.jnt_type[jntid]
    q = joints.jnt_qposadr[jntid]
    v = joints.jnt_dofadr[jntid]
    if kind == JointType.FREE:
        set_three(raw_out, worldid, q, three(tangent_in, worldid, v))
        q += 3
        v += 3
    if kind == JointType.FREE or kind == JointType.BALL:
        w = qpos_in[worldid, q]
        u = three(qpos_in, worldid, q + 1)
        g = three(tangent_in, worldid, v)
        square = w * w + wp.dot(u, u)
        if wp.abs(square - 1.0) > UNIT_ROUNDING:
            g /= square
        raw_out[worldid, q] = -2.0 * wp.dot(u, g)
        r = 2.0 * (w * g + wp.cross(u, g))
        set_three(raw_out, worldid, q + 1, r)
    else:
        raw_out[worldid, q] = tangent_in[worldid, v]


@wp.func
def is_zero(x: wp.array2d[float], worldid: int) -> bool:
    """Whether all of a row is zero; NaN is not."""
    for i in range(x.shape[1]):
        if x[worldid, i] != 0.0:
            return False
    return True


@wp.kernel
def mark_live(
    # In:
    qpos_in: wp.array2d[float],
    grad_qvel_in: wp.array2d[float],
    grad_act_in: wp.array2d[float],
    # Out:
    live_out: wp.array[int],
) -> None:
    """1 for a world whose cotangents are not all zero; only such worlds are given a gradient."""
    worldid = wp.tid()
    rest = is_zero(qpos_in, worldid) and is_zero(grad_qvel_in, worldid) and is_zero(grad_act_in, worldid)
    live_out[worldid] = wp.where(rest, 0, 1)


@wp.kernel
def clip_norm(
    # In:
    bound_in: float,
    # Out:
    grad_qpos_out: wp.array2d[float],
    grad_qvel_out: wp.array2d[float],
    grad_act_out: wp.array2d[float],
    clipped_out: wp.array[int],
) -> None:
    """Scales each world's state cotangent to at most `bound_in` in Euclidean norm, and counts where it did."""
    worldid = wp.tid()
    largest = float(0.0)
    for i in range(grad_qpos_out.shape[1]):
        largest = wp.max(largest, wp.max(wp.abs(grad_qpos_out[worldid, i]), wp.abs(grad_qvel_out[worldid, i])))
    for i in range(grad_act_out.shape[1]):
        largest = wp.max(largest, wp.abs(grad_act_out[worldid, i]))
    if not (largest > 0.0):
        return
    # Scaled by the largest entry, so that squares of exploding gradients do not overflow.
    total = float(0.0)
    for i in range(grad_qpos_out.shape[1]):
        a = grad_qpos_out[worldid, i] / largest
        b = grad_qvel_out[worldid, i] / largest
        total += a * a + b * b
    for i in range(grad_act_out.shape[1]):
        a = grad_act_out[worldid, i] / largest
        total += a * a
    norm = largest * wp.sqrt(total)
    if norm > bound_in:
        scale = bound_in / norm
        for i in range(grad_qpos_out.shape[1]):
            grad_qpos_out[worldid, i] = scale * grad_qpos_out[worldid, i]
            grad_qvel_out[worldid, i] = scale * grad_qvel_out[worldid, i]
        for i in range(grad_act_out.shape[1]):
            grad_act_out[worldid, i] = scale * grad_act_out[worldid, i]
        clipped_out[worldid] += 1


class Integrator:
    """Launches of the integration of positions, and of what begins and ends an env step's pullback.

    Attributes:
        damping_step: hB where it is diagonal, shape (W, nv).
    """

    def __init__(self, work: Workspace) -> None:
        self._work = work
        self.damping_step = wp.zeros((work.nworld, work.mjm.nv), dtype=float)

    def start(self, qpos: wp.array, raw_qpos: wp.array) -> None:
        """Launch the change of a raw cotangent (W, nq) at `qpos` to tangent coordinates, and find the live worlds."""
        work = self._work
        work.launch(project, (work.nworld, work.model.njnt), None, qpos=qpos, raw=raw_qpos, tangent=work.grad_qpos)
        work.launch(mark_live, work.nworld, None, qpos=raw_qpos)
        work.grad_ctrl.zero_()

    def finish(self, qpos: wp.array, raw_qpos: wp.array) -> None:
        """Launch the change of the tangent gradient at `qpos` to raw coordinates (W, nq)."""
        work = self._work
        work.launch(lift, (work.nworld, work.model.njnt), None, qpos=qpos, tangent=work.grad_qpos, raw=raw_qpos)

    def clip(self, bound: float, clipped: wp.array) -> None:
        """Launch the bound on each world's state cotangent; `clipped` (W,) counts where it acted."""
        self._work.launch(clip_norm, self._work.nworld, None, bound=bound, clipped=clipped)

    def launch(self, at: Substep, qvel_next: wp.array) -> None:
        """Launch the pullback of q' = q ⊕ h v' and the right-hand side of the first linear system."""
        work = self._work
        named = {"qvel": at.state.qvel, "qvel_next": qvel_next, "damping_step": self.damping_step}
        work.launch(pull_position, (work.nworld, work.model.njnt), at, **named)
