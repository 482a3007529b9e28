"""Spatial algebra on MuJoCo's com-based vectors: motions [ω; v] and forces [torque; force] about one fixed point."""

import warp as wp

from msk_ray.step.forward.mjw_private import motion_cross_force

wp.set_module_options({"enable_backward": False})


@wp.func
def point_velocity(motion: wp.spatial_vectorf, arm: wp.vec3) -> wp.vec3:
    """Velocity of the point at `arm` from the reference point: v + ω × r."""
    return wp.spatial_bottom(motion) + wp.cross(wp.spatial_top(motion), arm)


@wp.func
def wrench(force: wp.vec3, torque: wp.vec3, arm: wp.vec3) -> wp.spatial_vectorf:
    """Force at `arm` and a free torque, about the reference point: [t + r × f; f]."""
    return wp.spatial_vector(torque + wp.cross(arm, force), force)


@wp.func
def carried(motion: wp.spatial_vectorf, force: wp.spatial_vectorf) -> wp.spatial_vectorf:
    """Cotangent of a body's displacement w where f·(w × V) is the change of f·V: w·(V ×* f)."""
    return motion_cross_force(motion, force)


@wp.func
def three(x: wp.array2d[float], worldid: int, first: int) -> wp.vec3:
    """Three neighbours of a row."""
    return wp.vec3(x[worldid, first], x[worldid, first + 1], x[worldid, first + 2])


@wp.func
def four(x: wp.array2d[float], worldid: int, first: int) -> wp.quat:
    """Four neighbours of a row, as MuJoCo keeps a quaternion (w, x, y, z)."""
    return wp.quat(x[worldid, first], x[worldid, first + 1], x[worldid, first + 2], x[worldid, first + 3])


@wp.func
def set_three(x: wp.array2d[float], worldid: int, first: int, values: wp.vec3) -> None:
    """Write three neighbours of a row."""
    for i in range(3):
        x[worldid, first + i] = values[i]


@wp.func
def add_three(x: wp.array2d[float], worldid: int, first: int, values: wp.vec3) -> None:
    """Add to three neighbours of a row, to which other threads may add too."""
    for i in range(3):
        wp.atomic_add(x, worldid, first + i, values[i])


@wp.func
def column(matrix: wp.mat33, k: int) -> wp.vec3:
    """Column k of a matrix."""
    return wp.vec3(matrix[0, k], matrix[1, k], matrix[2, k])


@wp.func
def turning_torque(mat: wp.mat33, bar: wp.mat33) -> wp.vec3:
    """dR = [ω] R  ⇒  torque Σ_k R_k × R̄_k over the columns."""
    out = wp.cross(column(mat, 0), column(bar, 0)) + wp.cross(column(mat, 1), column(bar, 1))
    return out + wp.cross(column(mat, 2), column(bar, 2))


@wp.func
def quat_gradient(q: wp.quat, g: wp.vec3) -> wp.vec4:
    """2 q⊗[0, g]: the raw gradient of a unit quaternion (w, x, y, z) whose slope along local rotations is g."""
    u = wp.vec3(q[1], q[2], q[3])
    r = 2.0 * (q[0] * g + wp.cross(u, g))
    return wp.vec4(-2.0 * wp.dot(u, g), r[0], r[1], r[2])
