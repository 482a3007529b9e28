"""Free bodies that are alone in their tree: implicitfast integrates them with their gyroscopic forces.

For these six dofs mujoco_warp leaves out what actuators and tendons give -∂τ/∂v, and takes

    B = damping + drag + [0  m R G; 0  [ω]I - [Iω]] ,    G x = ∂(ω × (ω × s))/∂ω x = (ω·s) x + ω (s·x) - 2 s (ω·x)

with m and I the mass and inertia of all that moves with the body, I about its origin, s the centre of mass, ω, s and I
in its frame R. B is not symmetric: (M + hB)ᵀ μ = h v̄'. Its slopes with h μᵀ B â held are those of two trilinear forms.
"""

import math

import warp as wp

from msk_ray.step.adjoint.groups import DofSlopes, Motion, Multipliers, State, Substep
from msk_ray.step.adjoint.laws.fluid import FluidBodies, body_frame, drag_of, drag_slope, flow_past, seen_from
from msk_ray.step.adjoint.spatial import three
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import lu_factor_6x6, lu_solve_6x6, mat66, poly_force_deriv, vec6, vec10

wp.set_module_options({"enable_backward": False})

_NAN = wp.constant(math.nan)


@wp.struct
class FreeBodies:
    """Bodies with a free joint whose tree has no other dof."""

    free_body: wp.array[int]
    body_dofadr: wp.array[int]
    body_subtree_end: wp.array[int]
    inertia_address: wp.array2d[int]


@wp.struct
class Gyro:
    """What the gyroscopic forces of one free body are made of, in its frame."""

    mass: float
    """[kg]"""
    centre: wp.vec3
    """s [m]."""
    inertia: wp.mat33
    """I about the body's origin [kg m²]."""
    spin: wp.vec3
    """ω [rad/s]."""
    frame: wp.mat33
    """R."""


@wp.func
def inertia_block(free: FreeBodies, dof: int, worldid: int, M_in: wp.array2d[float]) -> mat66:
    """The body's block of M."""
    block = mat66(0.0)
    for i in range(6):
        for j in range(i + 1):
            address = free.inertia_address[dof + i, dof + j]
            if address >= 0:
                block[i, j] = M_in[worldid, address]
                block[j, i] = M_in[worldid, address]
    return block


@wp.func
def gyro_of(
    free: FreeBodies,
    body: int,
    worldid: int,
    xpos_in: wp.array2d[wp.vec3],
    xmat_in: wp.array2d[wp.mat33],
    motion_in: Motion,
    qvel_in: wp.array2d[float],
) -> Gyro:
    """Mass, centre, inertia and spin of a free body with all that is fixed to it."""
    total = vec10(0.0)
    for b in range(body, free.body_subtree_end[body]):
        total += motion_in.cinert[worldid, b]
    gyro = Gyro()
    gyro.mass = total[9]
    gyro.frame = xmat_in[worldid, body]
    back = wp.transpose(gyro.frame)
    gyro.centre = back @ (motion_in.subtree_com[worldid, body] - xpos_in[worldid, body])
    about_centre = wp.mat33(total[0], total[3], total[4], total[3], total[1], total[5], total[4], total[5], total[2])
    s = gyro.centre
    shift = gyro.mass * (wp.dot(s, s) * wp.identity(n=3, dtype=float) - wp.outer(s, s))
    gyro.inertia = back @ about_centre @ gyro.frame + shift
    dof = free.body_dofadr[body] + 3
    gyro.spin = three(qvel_in, worldid, dof)
    return gyro


@wp.func
def implicit_step(
    free: FreeBodies,
    bodies: FluidBodies,
    body: int,
    worldid: int,
    damper_on: bool,
    fluid_on: bool,
    gyro: Gyro,
    xmat_in: wp.array2d[wp.mat33],
    damping_in: wp.array2d[wp.vec3],
    motion_in: Motion,
    qvel_in: wp.array2d[float],
) -> mat66:
    """B of one free body."""
    dof = free.body_dofadr[body]
    step = mat66(0.0)
    if damper_on:
        for i in range(6):
            c = damping_in[worldid, dof + i]
            step[i, i] = poly_force_deriv(c[0], wp.vec2(c[1], c[2]), qvel_in[worldid, dof + i], 1)
    w = gyro.spin
    s = gyro.centre
    linear = wp.dot(w, s) * wp.identity(n=3, dtype=float) + wp.outer(w, s) - 2.0 * wp.outer(s, w)
    linear = gyro.mass * (gyro.frame @ linear)
    turning = wp.skew(w) @ gyro.inertia - wp.skew(gyro.inertia @ w)
    for i in range(3):
        for j in range(3):
            step[i, 3 + j] += linear[i, j]
            step[3 + i, 3 + j] += turning[i, j]
    if fluid_on:
        for b in range(body, free.body_subtree_end[body]):
            frame = body_frame(bodies, worldid, b, xmat_in[worldid, b])
            arm = motion_in.xipos[worldid, b] - motion_in.subtree_com[worldid, bodies.body_rootid[b]]
            drag = drag_of(bodies, worldid, b)
            slope = drag_slope(drag, flow_past(drag, frame, arm, motion_in.cvel[worldid, b]))
            for i in range(6):
                push = wp.cw_mul(slope, seen_from(frame, arm, motion_in.cdof[worldid, dof + i]))
                for j in range(6):
                    step[i, j] += wp.dot(push, seen_from(frame, arm, motion_in.cdof[worldid, dof + j]))
    return step


@wp.func
def solved(matrix: mat66, right: vec6) -> vec6:
    """matrix⁻¹ right; NaN where it is singular."""
    factor, pivot, regular = lu_factor_6x6(matrix)
    out = vec6(_NAN)
    if regular:
        out = lu_solve_6x6(factor, pivot, right)
    return out


@wp.func
def free_slopes(gyro: Gyro, mu: vec6, smooth: vec6) -> wp.spatial_vectorf:
    """Slopes of μᵀ B â to the body's turning (first) and to ω, from the gyroscopic part of B."""
    s = gyro.centre
    w = gyro.spin
    x = wp.vec3(smooth[3], smooth[4], smooth[5])
    y = wp.vec3(mu[3], mu[4], mu[5])
    nu = wp.transpose(gyro.frame) @ wp.vec3(mu[0], mu[1], mu[2])
    # m ν·G x, in which ν = Rᵀ μ turns by -w × ν
    gx = wp.dot(w, s) * x + wp.dot(s, x) * w - 2.0 * wp.dot(w, x) * s
    turn = wp.cross(gyro.mass * gx, nu)
    spin = gyro.mass * (wp.dot(nu, x) * s + wp.dot(s, x) * nu - 2.0 * wp.dot(nu, s) * x)
    # y·(ω × I x) - y·(I ω × x)
    spin += wp.cross(gyro.inertia @ x, y) - gyro.inertia @ wp.cross(x, y)
    return wp.spatial_vector(turn, spin)


@wp.kernel
def hold_free_rows(
    # Model:
    free: FreeBodies,
    # In:
    M_in: wp.array2d[float],
    # Out:
    step_out: wp.array2d[float],
) -> None:
    """M in the rows of M + hB that belong to free bodies, which are solved apart."""
    worldid, k = wp.tid()
    dof = free.body_dofadr[free.free_body[k]]
    for i in range(6):
        for j in range(i + 1):
            address = free.inertia_address[dof + i, dof + j]
            if address >= 0:
                step_out[worldid, address] = M_in[worldid, address]


@wp.kernel
def solve_free(
    # Model:
    free: FreeBodies,
    bodies: FluidBodies,
    damper_on: bool,
    fluid_on: bool,
    # In:
    M_in: wp.array2d[float],
    xpos_in: wp.array2d[wp.vec3],
    xmat_in: wp.array2d[wp.mat33],
    damping_in: wp.array2d[wp.vec3],
    motion_in: Motion,
    state_in: State,
    rhs_in: wp.array2d[float],
    # Out:
    multipliers_out: Multipliers,
    push_out: wp.array2d[float],
    slopes_out: DofSlopes,
) -> None:
    """μ, a - â and M μ of each free body, and the slopes that h μᵀ B â has through the body's turning and spin."""
    worldid, k = wp.tid()
    body = free.free_body[k]
    dof = free.body_dofadr[body]
    h = bodies.timestep[worldid % bodies.timestep.shape[0]]
    gyro = gyro_of(free, body, worldid, xpos_in, xmat_in, motion_in, state_in.qvel)
    step = h * implicit_step(
        free, bodies, body, worldid, damper_on, fluid_on, gyro, xmat_in, damping_in, motion_in, state_in.qvel
    )
    block = inertia_block(free, dof, worldid, M_in)
    matrix = block + step
    rhs = vec6(0.0)
    acc = vec6(0.0)
    for i in range(6):
        rhs[i] = rhs_in[worldid, dof + i]
        acc[i] = state_in.qacc[worldid, dof + i]
    mu = solved(wp.transpose(matrix), rhs)
    excess = solved(matrix, step @ acc)
    push = block @ mu
    slopes = h * free_slopes(gyro, mu, acc - excess)
    for i in range(6):
        multipliers_out.mu[worldid, dof + i] = mu[i]
        multipliers_out.excess[worldid, dof + i] = excess[i]
        push_out[worldid, dof + i] = push[i]
    for i in range(3):
        slopes_out.qpos[worldid, dof + 3 + i] += slopes[i]
        slopes_out.qvel[worldid, dof + 3 + i] += slopes[3 + i]


class FreeBodySolves:
    """Launches of the free bodies' own systems."""

    def __init__(self, work: Workspace) -> None:
        self._work = work
        self._shape = (work.nworld, work.tables.free_body.size)

    def hold(self, at: Substep, step: wp.array) -> None:
        """Launch M into the rows of `step` that belong to free bodies, M + hB in M's sparse layout."""
        self._work.launch(hold_free_rows, self._shape, at, step=step)

    def launch(self, at: Substep, push: wp.array) -> None:
        """Launch μ, a - â, the slopes of B, and M μ into `push`, shape (W, nv)."""
        self._work.launch(solve_free, self._shape, at, push=push)
