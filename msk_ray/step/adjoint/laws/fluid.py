"""Drag of a fluid on bodies, each taken as a box of the same inertia (MuJoCo's inertia-box model).

In the frame of a body's inertia, its velocity x relative to the fluid (rotation, then translation of the centre of
mass, six numbers) gives the force -(l_i + k_i |x_i|) x_i along each axis. So Φ ∋ L·(l + k|x|) x with L the field of λ
there; and, because implicit integration takes this force's slope c = l + 2k|x| into B, Φ ∋ h V(μ)·c V(â).
"""

import math

import warp as wp

from msk_ray.step.adjoint.groups import FieldBars, Fields, Motion, Substep
from msk_ray.step.adjoint.spatial import point_velocity, wrench
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import quat_to_mat, vec6

wp.set_module_options({"enable_backward": False})

_PI = wp.constant(math.pi)
_LEAST_MASS = wp.constant(1.0e-15)
"""Bodies lighter than this feel no fluid [kg]."""


@wp.struct
class FluidBodies:
    """The fluid, and the masses and inertias of bodies."""

    timestep: wp.array[float]
    density: wp.array[float]
    viscosity: wp.array[float]
    wind: wp.array[wp.vec3]
    body_rootid: wp.array[int]
    body_mass: wp.array2d[float]
    body_inertia: wp.array2d[wp.vec3]
    body_iquat: wp.array2d[wp.quat]


@wp.struct
class Drag:
    """Coefficients of a body's drag along the axes of its inertia, rotation first."""

    linear: vec6
    """l [N m s/rad, N s/m]."""
    quadratic: vec6
    """k [N m s²/rad², N s²/m²]."""
    wind: wp.vec3
    """Velocity of the fluid in the world's frame [m/s]."""


@wp.func
def fourth_power(x: float) -> float:
    """x⁴."""
    return x * x * x * x


@wp.func
def drag_of(bodies: FluidBodies, worldid: int, body: int) -> Drag:
    """The drag of one body; zero for one without mass."""
    drag = Drag()
    drag.wind = bodies.wind[worldid % bodies.wind.shape[0]]
    mass = bodies.body_mass[worldid % bodies.body_mass.shape[0], body]
    if body == 0 or mass < _LEAST_MASS:
        return drag
    density = bodies.density[worldid % bodies.density.shape[0]]
    viscosity = bodies.viscosity[worldid % bodies.viscosity.shape[0]]
    inertia = bodies.body_inertia[worldid % bodies.body_inertia.shape[0], body]
    # Edges of the box: I₁ + I₂ - I₀ = m a₀²/6
    a = wp.vec3(
        wp.sqrt(6.0 * wp.max(inertia[1] + inertia[2] - inertia[0], _LEAST_MASS) / mass),
        wp.sqrt(6.0 * wp.max(inertia[0] + inertia[2] - inertia[1], _LEAST_MASS) / mass),
        wp.sqrt(6.0 * wp.max(inertia[0] + inertia[1] - inertia[2], _LEAST_MASS) / mass),
    )
    if viscosity > 0.0:
        # A sphere of the mean edge as its diameter
        d = (a[0] + a[1] + a[2]) / 3.0
        spin = _PI * viscosity * d * d * d
        push = 3.0 * _PI * viscosity * d
        drag.linear = vec6(spin, spin, spin, push, push, push)
    if density > 0.0:
        share = density / 64.0
        b = wp.vec3(fourth_power(a[0]), fourth_power(a[1]), fourth_power(a[2]))
        drag.quadratic = vec6(
            share * a[0] * (b[1] + b[2]),
            share * a[1] * (b[0] + b[2]),
            share * a[2] * (b[0] + b[1]),
            0.5 * density * a[1] * a[2],
            0.5 * density * a[0] * a[2],
            0.5 * density * a[0] * a[1],
        )
    return drag


@wp.func
def body_frame(bodies: FluidBodies, worldid: int, body: int, xmat: wp.mat33) -> wp.mat33:
    """Axes of a body's inertia in the world, as columns."""
    return xmat @ quat_to_mat(bodies.body_iquat[worldid % bodies.body_iquat.shape[0], body])


@wp.func
def seen_from(frame: wp.mat33, arm: wp.vec3, motion: wp.spatial_vectorf) -> vec6:
    """A twist as rotation and velocity of the point at `arm`, in `frame`."""
    back = wp.transpose(frame)
    spin = back @ wp.spatial_top(motion)
    rate = back @ point_velocity(motion, arm)
    return vec6(spin[0], spin[1], spin[2], rate[0], rate[1], rate[2])


@wp.func
def load_of(frame: wp.mat33, arm: wp.vec3, bar: vec6) -> wp.spatial_vectorf:
    """The wrench of a cotangent of `seen_from`."""
    return wrench(frame @ wp.vec3(bar[3], bar[4], bar[5]), frame @ wp.vec3(bar[0], bar[1], bar[2]), arm)


@wp.func
def flow_past(drag: Drag, frame: wp.mat33, arm: wp.vec3, motion: wp.spatial_vectorf) -> vec6:
    """x: a body's velocity relative to the fluid, in its own frame."""
    wind = wp.transpose(frame) @ drag.wind
    x = seen_from(frame, arm, motion)
    for i in range(3):
        x[3 + i] -= wind[i]
    return x


@wp.func
def drag_slope(drag: Drag, velocity: vec6) -> vec6:
    """c = l + 2k|x|, by axis."""
    out = vec6(0.0)
    for i in range(6):
        out[i] = drag.linear[i] + 2.0 * drag.quadratic[i] * wp.abs(velocity[i])
    return out


@wp.kernel
def pull_fluid(
    # Model:
    bodies: FluidBodies,
    implicit_all: bool,
    # In:
    xmat_in: wp.array2d[wp.mat33],
    motion_in: Motion,
    fields_in: Fields,
    # Out:
    bars_out: FieldBars,
) -> None:
    """Φ ∋ L·(l + k|x|) x, and with implicit integration h V(μ)·c V(â)."""
    worldid, body = wp.tid()
    drag = drag_of(bodies, worldid, body)
    frame = body_frame(bodies, worldid, body, xmat_in[worldid, body])
    arm = motion_in.xipos[worldid, body] - motion_in.subtree_com[worldid, bodies.body_rootid[body]]
    x = flow_past(drag, frame, arm, motion_in.cvel[worldid, body])
    lam = seen_from(frame, arm, fields_in.lam[worldid, body])
    slope = drag_slope(drag, x)
    lam_bar = vec6(0.0)
    vel_bar = vec6(0.0)
    for i in range(6):
        lam_bar[i] = (drag.linear[i] + drag.quadratic[i] * wp.abs(x[i])) * x[i]
        vel_bar[i] = slope[i] * lam[i]
    if implicit_all:
        h = bodies.timestep[worldid % bodies.timestep.shape[0]]
        mu = seen_from(frame, arm, fields_in.mu[worldid, body])
        smooth = seen_from(frame, arm, fields_in.qacc[worldid, body] - fields_in.excess[worldid, body])
        mu_bar = vec6(0.0)
        smooth_bar = vec6(0.0)
        for i in range(6):
            mu_bar[i] = h * slope[i] * smooth[i]
            smooth_bar[i] = h * slope[i] * mu[i]
            vel_bar[i] += 2.0 * h * drag.quadratic[i] * wp.sign(x[i]) * mu[i] * smooth[i]
        smooth_load = load_of(frame, arm, smooth_bar)
        wp.atomic_add(bars_out.mu, worldid, body, load_of(frame, arm, mu_bar))
        # â = a - (a - â): its cotangent goes to both fields
        wp.atomic_add(bars_out.qacc, worldid, body, smooth_load)
        wp.atomic_add(bars_out.excess, worldid, body, -smooth_load)
    wp.atomic_add(bars_out.lam, worldid, body, load_of(frame, arm, lam_bar))
    wp.atomic_add(bars_out.qvel, worldid, body, load_of(frame, arm, vel_bar))
    # The wind does not turn with the body: seen from it, x gains ω(w) × wind.
    turn = wp.cross(drag.wind, frame @ wp.vec3(vel_bar[3], vel_bar[4], vel_bar[5]))
    wp.atomic_add(bars_out.moved, worldid, body, wp.spatial_vector(turn, wp.vec3(0.0)))


def launch_fluid(work: Workspace, at: Substep) -> None:
    """Launch what drag gives ∂Φ."""
    work.launch(pull_fluid, (work.nworld, work.model.nbody), at)
