"""Springs of free and ball joints."""

import warp as wp
from mujoco_warp import JointType

from msk_ray.physics.mjw_private import poly_force, quat_sub

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
def spring_slope(stiffness: float, poly: wp.vec2, dif: wp.vec3, lam: wp.vec3) -> wp.vec3:
    """∂/∂d of k(|d|) λ·d, k = k₀ + p₀|d| + p₁|d|²."""
    r = wp.length(dif)
    out = poly_force(stiffness, poly, r, 0) * lam
    if r > 0.0:
        out += (poly[0] / r + 2.0 * poly[1]) * wp.dot(lam, dif) * dif
    return out


@wp.kernel
def pull_turning_springs(
    # Model:
    qpos_spring: wp.array2d[float],
    jnt_type: wp.array[int],
    jnt_qposadr: wp.array[int],
    jnt_dofadr: wp.array[int],
    jnt_stiffness: wp.array2d[float],
    jnt_stiffnesspoly: wp.array2d[wp.vec2],
    # In:
    qpos_in: wp.array2d[float],
    lam_in: wp.array2d[float],
    # Out:
    phi_qpos_out: wp.array2d[float],
) -> None:
    """Φ ∋ λ·k(|d|) d: d the displacement from rest, for a rotation its logarithm."""
    worldid, jntid = wp.tid()
    kind = jnt_type[jntid]
    if kind != JointType.FREE and kind != JointType.BALL:
        return
    stiffness = jnt_stiffness[worldid % jnt_stiffness.shape[0], jntid]
    poly = jnt_stiffnesspoly[worldid % jnt_stiffnesspoly.shape[0], jntid]
    if stiffness == 0.0 and poly[0] == 0.0 and poly[1] == 0.0:
        return
    q = jnt_qposadr[jntid]
    v = jnt_dofadr[jntid]
    rest = worldid % qpos_spring.shape[0]
    if kind == JointType.FREE:
        dif = wp.vec3(0.0)
        lam = wp.vec3(0.0)
        for i in range(3):
            dif[i] = qpos_in[worldid, q + i] - qpos_spring[rest, q + i]
            lam[i] = lam_in[worldid, v + i]
        slope = spring_slope(stiffness, poly, dif, lam)
        for i in range(3):
            wp.atomic_add(phi_qpos_out, worldid, v + i, slope[i])
        q += 3
        v += 3
    now = wp.quat(qpos_in[worldid, q], qpos_in[worldid, q + 1], qpos_in[worldid, q + 2], qpos_in[worldid, q + 3])
    still = wp.quat(qpos_spring[rest, q], qpos_spring[rest, q + 1], qpos_spring[rest, q + 2], qpos_spring[rest, q + 3])
    phi = quat_sub(wp.normalize(now), still)
    turn = wp.vec3(lam_in[worldid, v], lam_in[worldid, v + 1], lam_in[worldid, v + 2])
    slope = log_rate_pullback(phi, spring_slope(stiffness, poly, phi, turn))
    for i in range(3):
        wp.atomic_add(phi_qpos_out, worldid, v + i, slope[i])
