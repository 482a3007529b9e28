"""Mass, inertia and centre of mass of bodies, and gravity.

With u and ω the velocity of a body's centre of mass and its spin under a field, a_c the acceleration of that point less
gravity, α the angular one and I the inertia about it, what a body gives Φ is

    m (u_λ·a_c - u_μ·u_e) + ω_λ·Iα + (ω_λ × ω)·Iω - ω_μ·Iω_e ,  e = a - â ,

linear in the ten inertial parameters once the point is fixed.
"""

import warp as wp

from msk_ray.step.adjoint.groups import Fields, Motion, Substep
from msk_ray.step.adjoint.parameters.base import ParameterFamily
from msk_ray.step.adjoint.spatial import point_velocity, quat_gradient

wp.set_module_options({"enable_backward": False})


@wp.struct
class InertiaGradients:
    """Gradients of inertial parameters, (W, B), and of gravity, (W,)."""

    body_mass: wp.array2d[float]
    body_inertia: wp.array2d[wp.vec3]
    body_ipos: wp.array2d[wp.vec3]
    body_iquat: wp.array2d[wp.vec4]
    gravity: wp.array[wp.vec3]


@wp.func
def rotation(q: wp.quat) -> wp.mat33:
    """Matrix of MuJoCo's quaternion (w, x, y, z), kept in a wp.quat in that order."""
    return wp.quat_to_matrix(wp.quat(q[1], q[2], q[3], q[0]))


@wp.kernel
def pull_inertia(
    # Model:
    opt_gravity: wp.array[wp.vec3],
    gravity_on: bool,
    body_rootid: wp.array[int],
    body_mass: wp.array2d[float],
    body_inertia: wp.array2d[wp.vec3],
    body_iquat: wp.array2d[wp.quat],
    body_gravcomp: wp.array2d[float],
    # In:
    live_in: wp.array[int],
    xfrc_applied_in: wp.array2d[wp.spatial_vector],
    xmat_in: wp.array2d[wp.mat33],
    motion_in: Motion,
    fields_in: Fields,
    # Out:
    gradients_out: InertiaGradients,
) -> None:
    """θ̄ -= ∂Φ/∂θ of one body's inertial parameters, and of gravity."""
    worldid, body = wp.tid()
    if body == 0 or live_in[worldid] == 0:
        return
    mass = body_mass[worldid % body_mass.shape[0], body]
    moments = body_inertia[worldid % body_inertia.shape[0], body]
    quat = body_iquat[worldid % body_iquat.shape[0], body]
    comp = body_gravcomp[worldid % body_gravcomp.shape[0], body]
    arm = motion_in.xipos[worldid, body] - motion_in.subtree_com[worldid, body_rootid[body]]
    lam = fields_in.lam[worldid, body]
    acc = fields_in.cacc[worldid, body]
    vel = motion_in.cvel[worldid, body]
    mu = fields_in.mu[worldid, body]
    excess = fields_in.excess[worldid, body]
    w_lam = wp.spatial_top(lam)
    w = wp.spatial_top(vel)
    alpha = wp.spatial_top(acc)
    w_mu = wp.spatial_top(mu)
    w_e = wp.spatial_top(excess)
    u_lam = point_velocity(lam, arm)
    u_mu = point_velocity(mu, arm)
    u_e = point_velocity(excess, arm)
    # acceleration of a point of the body: A + α × r + ω × u
    a_c = point_velocity(acc, arm) + wp.cross(w, point_velocity(vel, arm))

    slope = wp.dot(u_lam, a_c) - wp.dot(u_mu, u_e)
    # δu = ω × δc ,  δa_c = α × δc + ω × (ω × δc)
    shift = wp.cross(a_c, w_lam) + wp.cross(u_lam, alpha) + wp.cross(wp.cross(u_lam, w), w)
    shift -= wp.cross(u_e, w_mu) + wp.cross(u_mu, w_e)
    # A force from outside acts at the centre of mass: Φ ∋ -u_λ·F
    pushed = wp.cross(wp.spatial_top(xfrc_applied_in[worldid, body]), w_lam)
    if gravity_on:
        # Φ ∋ m (comp - 1) u_λ·g, of which a_c holds the part without comp
        gravity = opt_gravity[worldid % opt_gravity.shape[0]]
        slope += comp * wp.dot(gravity, u_lam)
        shift += comp * wp.cross(gravity, w_lam)
        wp.atomic_sub(gradients_out.gravity, worldid, mass * (comp - 1.0) * u_lam)
    gradients_out.body_mass[worldid, body] = gradients_out.body_mass[worldid, body] - slope
    mat = xmat_in[worldid, body]
    gradients_out.body_ipos[worldid, body] = gradients_out.body_ipos[worldid, body] - wp.transpose(mat) @ (
        mass * shift - pushed
    )

    # In the principal frame I is diagonal: x·Iy has the slope x_k y_k, and turns by Iy × x + Ix × y.
    local = wp.transpose(mat @ rotation(quat))
    x1 = local @ w_lam
    y1 = local @ alpha
    x2 = local @ wp.cross(w_lam, w)
    y2 = local @ w
    x3 = local @ w_mu
    y3 = local @ w_e
    spread = wp.cw_mul(x1, y1) + wp.cw_mul(x2, y2) - wp.cw_mul(x3, y3)
    gradients_out.body_inertia[worldid, body] = gradients_out.body_inertia[worldid, body] - spread
    turn = wp.cross(wp.cw_mul(moments, y1), x1) + wp.cross(wp.cw_mul(moments, x1), y1)
    turn += wp.cross(wp.cw_mul(moments, y2), x2) + wp.cross(wp.cw_mul(moments, x2), y2)
    turn -= wp.cross(wp.cw_mul(moments, y3), x3) + wp.cross(wp.cw_mul(moments, x3), y3)
    gradients_out.body_iquat[worldid, body] = gradients_out.body_iquat[worldid, body] - quat_gradient(quat, turn)


class InertiaFamily(ParameterFamily):
    """Launches of the inertial parameters' gradients."""

    kinds = (InertiaGradients,)

    def launch(self, at: Substep) -> None:
        self.work.launch(pull_inertia, (self.work.nworld, self.work.model.nbody), at, *self.gradients)
