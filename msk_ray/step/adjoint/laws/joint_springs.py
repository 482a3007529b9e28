"""Springs of free and ball joints: Φ ∋ k(|d|) λ·d, k = k₀ + p₀|d| + p₁|d|².

d is the displacement from rest, for a rotation its logarithm; that of hinges and slides is in `bodies.sweep_up`.
"""

import warp as wp
from mujoco_warp import JointType

from msk_ray.step.adjoint.groups import DofSlopes, Joints, Springs, State, Substep
from msk_ray.step.adjoint.spatial import add_three, four, three
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import poly_force, quat_sub

wp.set_module_options({"enable_backward": False})


@wp.func
def log_rate_pullback(phi: wp.vec3, g: wp.vec3) -> wp.vec3:
    """Jr(φ)⁻ᵀ g, where log(exp(φ) exp(w)) = φ + Jr⁻¹ w: g - ½ φ × g + c φ × (φ × g)."""
    square = wp.dot(phi, phi)
    c = 1.0 / 12.0 + square / 720.0
    if square > 1.0e-2:
        half = 0.5 * wp.sqrt(square)
        c = (1.0 - half / wp.tan(half)) / square
    cross = wp.cross(phi, g)
    return g - 0.5 * cross + c * wp.cross(phi, cross)


@wp.func
def spring_slope(stiffness: float, poly: wp.vec2, shift: wp.vec3, lam: wp.vec3) -> wp.vec3:
    """∂/∂d of k(|d|) λ·d, k = k₀ + p₀|d| + p₁|d|²."""
    r = wp.length(shift)
    out = poly_force(stiffness, poly, r, 0) * lam
    if r > 0.0:
        out += (poly[0] / r + 2.0 * poly[1]) * wp.dot(lam, shift) * shift
    return out


@wp.kernel
def pull_turning_springs(
    # Model:
    joints: Joints,
    springs: Springs,
    # In:
    state_in: State,
    lam_in: wp.array2d[float],
    # Out:
    slopes_out: DofSlopes,
) -> None:
    """Φ ∋ λ·k(|d|) d: d the displacement from rest, for a rotation its logarithm."""
    worldid, jntid = wp.tid()
    kind = joints.jnt_type[jntid]
    if kind != JointType.FREE and kind != JointType.BALL:
        return
    stiffness = springs.jnt_stiffness[worldid % springs.jnt_stiffness.shape[0], jntid]
    poly = springs.jnt_stiffnesspoly[worldid % springs.jnt_stiffnesspoly.shape[0], jntid]
    if stiffness == 0.0 and poly[0] == 0.0 and poly[1] == 0.0:
        return
    q = joints.jnt_qposadr[jntid]
    v = joints.jnt_dofadr[jntid]
    rest = worldid % springs.qpos_spring.shape[0]
    if kind == JointType.FREE:
        shift = three(state_in.qpos, worldid, q) - three(springs.qpos_spring, rest, q)
        lam = three(lam_in, worldid, v)
        slope = spring_slope(stiffness, poly, shift, lam)
        add_three(slopes_out.qpos, worldid, v, slope)
        q += 3
        v += 3
    quat = four(state_in.qpos, worldid, q)
    rest_quat = four(springs.qpos_spring, rest, q)
    phi = quat_sub(wp.normalize(quat), rest_quat)
    turn = three(lam_in, worldid, v)
    slope = log_rate_pullback(phi, spring_slope(stiffness, poly, phi, turn))
    add_three(slopes_out.qpos, worldid, v, slope)


def launch_turning_springs(work: Workspace, at: Substep) -> None:
    """Launch what springs of free and ball joints give ∂Φ."""
    work.launch(pull_turning_springs, (work.nworld, work.model.njnt), at, lam=work.multipliers.lam)
