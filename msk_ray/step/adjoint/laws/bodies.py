"""Twist fields of all bodies, and the tree sweep that turns cotangents of twists into cotangents of (q, v).

Notation: S_j is the unit twist of dof j, V_b(x) = Σ S_j x_j over the dofs that move body b. For a displacement w
of the configuration, a twist's change seen from its own body is

    δL_b = Σ_j (L_{<j} × S_j) w_j                                   (L, U: plain fields of λ and a)
    δV likewise;  δA_j = δA_{<j} + A_{<j} × S_j w_j + δV_j × S_j v_j   (A: accelerations with velocity products)

where `<j` is the field just before joint j (a ball's three dofs count as one joint). Inertias do not change seen
from their own body, so λᵀ(M a + bias) = Σ_b L·(I A + V ×* I V) needs nothing else.
"""

import warp as wp

from msk_ray.step.adjoint.groups import DofSlopes, FieldBars, Fields, Motion, Multipliers, Springs, State, Substep
from msk_ray.step.adjoint.spatial import carried, wrench
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import inert_vec, motion_cross_force, poly_force_deriv

wp.set_module_options({"enable_backward": False})


@wp.struct
class Tree:
    """Bodies and dofs of the kinematic tree."""

    body_rootid: wp.array[int]
    body_parentid: wp.array[int]
    body_dofadr: wp.array[int]
    body_dofnum: wp.array[int]
    body_lastdof: wp.array[int]
    body_subtree_end: wp.array[int]
    body_mass: wp.array2d[float]
    body_gravcomp: wp.array2d[float]
    dof_bodyid: wp.array[int]
    dof_parentid: wp.array[int]
    dof_first: wp.array[int]
    dof_last: wp.array[int]


@wp.kernel
def body_fields(
    # Model:
    opt_gravity: wp.array[wp.vec3],
    gravity_on: bool,
    tree: Tree,
    # In:
    motion_in: Motion,
    state_in: State,
    multipliers_in: Multipliers,
    # Out:
    fields_out: Fields,
    bars_out: FieldBars,
) -> None:
    """Fields of λ, a, μ and a - â, the acceleration A, and the cotangents that inertia gives them."""
    worldid, bodyid = wp.tid()
    zero = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    lam = zero
    pure = zero
    bias = zero
    mu = zero
    excess = zero
    if gravity_on:
        bias = wp.spatial_vector(wp.vec3(0.0), -opt_gravity[worldid % opt_gravity.shape[0]])
    j = tree.body_lastdof[bodyid]
    while j >= 0:
        s = motion_in.cdof[worldid, j]
        lam += s * multipliers_in.lam[worldid, j]
        pure += s * state_in.qacc[worldid, j]
        bias += motion_in.cdof_dot[worldid, j] * state_in.qvel[worldid, j]
        mu += s * multipliers_in.mu[worldid, j]
        excess += s * multipliers_in.excess[worldid, j]
        j = tree.dof_parentid[j]
    acc = pure + bias
    fields_out.lam[worldid, bodyid] = lam
    fields_out.qacc[worldid, bodyid] = pure
    fields_out.cacc[worldid, bodyid] = acc
    fields_out.mu[worldid, bodyid] = mu
    fields_out.excess[worldid, bodyid] = excess
    inertia = motion_in.cinert[worldid, bodyid]
    vel = motion_in.cvel[worldid, bodyid]
    momentum = inert_vec(inertia, vel)
    # ∂/∂L of L·(I A + V ×* I V)
    bars_out.lam[worldid, bodyid] = inert_vec(inertia, acc) + motion_cross_force(vel, momentum)
    # ∂/∂V: (δV ×* IV + V ×* I δV)·L = -δV·(L ×* IV) - δV·I(V × L)
    top = wp.spatial_top(vel)
    bottom = wp.spatial_bottom(vel)
    lam_top = wp.spatial_top(lam)
    crossed = wp.spatial_vector(
        wp.cross(top, lam_top), wp.cross(bottom, lam_top) + wp.cross(top, wp.spatial_bottom(lam))
    )
    bars_out.qvel[worldid, bodyid] = -motion_cross_force(lam, momentum) - inert_vec(inertia, crossed)
    # ∂/∂A = I L
    bars_out.cacc[worldid, bodyid] = inert_vec(inertia, lam)
    bars_out.qacc[worldid, bodyid] = zero
    # -μᵀM(a - â) = -Σ_b V_b(μ)·I V_b(a - â), bilinear in two plain fields
    bars_out.mu[worldid, bodyid] = -inert_vec(inertia, excess)
    bars_out.excess[worldid, bodyid] = -inert_vec(inertia, mu)
    moved = zero
    comp = tree.body_gravcomp[worldid % tree.body_gravcomp.shape[0], bodyid]
    if gravity_on and comp != 0.0:
        # Φ ∋ -u(λ)·F at the body's centre of mass, F = -gravity m comp fixed in the world
        mass = tree.body_mass[worldid % tree.body_mass.shape[0], bodyid]
        push = comp * mass * opt_gravity[worldid % opt_gravity.shape[0]]
        arm = motion_in.xipos[worldid, bodyid] - motion_in.subtree_com[worldid, tree.body_rootid[bodyid]]
        along = wrench(push, wp.vec3(0.0), arm)
        bars_out.lam[worldid, bodyid] = bars_out.lam[worldid, bodyid] + along
        moved = carried(lam, along) + wrench(wp.cross(push, wp.spatial_top(lam)), wp.vec3(0.0), arm)
    bars_out.moved[worldid, bodyid] = moved


@wp.kernel
def close_velocity(
    # Model:
    tree: Tree,
    # In:
    motion_in: Motion,
    state_in: State,
    # Out:
    bars_out: FieldBars,
    cacc_sum_out: wp.array2d[wp.spatial_vector],
) -> None:
    """Σ of Ā over each subtree, and what δA_j ∋ δV_j × S_j v_j adds to V̄: (S_j v_j) ×* Σ Ā."""
    worldid, bodyid = wp.tid()
    total = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for b in range(bodyid, tree.body_subtree_end[bodyid]):
        total += bars_out.cacc[worldid, b]
    cacc_sum_out[worldid, bodyid] = total
    own = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    start = tree.body_dofadr[bodyid]
    for j in range(start, start + tree.body_dofnum[bodyid]):
        own += motion_in.cdof[worldid, j] * state_in.qvel[worldid, j]
    bars_out.qvel[worldid, bodyid] = bars_out.qvel[worldid, bodyid] + motion_cross_force(own, total)


@wp.kernel
def sweep_up(
    # Model:
    opt_timestep: wp.array[float],
    tree: Tree,
    springs: Springs,
    damper_on: bool,
    implicit_damping: bool,
    # In:
    live_in: wp.array[int],
    damping_in: wp.array2d[wp.vec3],
    motion_in: Motion,
    state_in: State,
    multipliers_in: Multipliers,
    fields_in: Fields,
    bars_in: FieldBars,
    cacc_sum_in: wp.array2d[wp.spatial_vector],
    slopes_in: DofSlopes,
    # Out:
    grad_qpos_out: wp.array2d[float],
    grad_qvel_out: wp.array2d[float],
) -> None:
    """Gradient of one dof: q̄ -= ∂Φ/∂q, v̄ -= ∂Φ/∂v, from the bodies it moves and its own spring and damper."""
    worldid, j = wp.tid()
    if live_in[worldid] == 0:
        grad_qpos_out[worldid, j] = 0.0
        grad_qvel_out[worldid, j] = 0.0
        return
    body = tree.dof_bodyid[j]
    zero = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    lam_bar = zero
    qvel_bar = zero
    qacc_bar = zero
    moved_bar = zero
    mu_bar = zero
    excess_bar = zero
    for b in range(body, tree.body_subtree_end[body]):
        lam_bar += bars_in.lam[worldid, b]
        qvel_bar += bars_in.qvel[worldid, b]
        qacc_bar += bars_in.qacc[worldid, b]
        moved_bar += bars_in.moved[worldid, b]
        mu_bar += bars_in.mu[worldid, b]
        excess_bar += bars_in.excess[worldid, b]
    cacc_bar = cacc_sum_in[worldid, body]

    # Fields just before this joint, and V̄ less what `close_velocity` added for this body's joints before it.
    parent = tree.body_parentid[body]
    lam = fields_in.lam[worldid, parent]
    pure = fields_in.qacc[worldid, parent]
    acc = fields_in.cacc[worldid, parent]
    vel = motion_in.cvel[worldid, parent]
    mu = fields_in.mu[worldid, parent]
    excess = fields_in.excess[worldid, parent]
    before = zero
    start = tree.body_dofadr[body]
    for k in range(start, tree.dof_first[j]):
        s = motion_in.cdof[worldid, k]
        lam += s * multipliers_in.lam[worldid, k]
        pure += s * state_in.qacc[worldid, k]
        acc += s * state_in.qacc[worldid, k] + motion_in.cdof_dot[worldid, k] * state_in.qvel[worldid, k]
        vel += s * state_in.qvel[worldid, k]
        mu += s * multipliers_in.mu[worldid, k]
        excess += s * multipliers_in.excess[worldid, k]
        before += s * state_in.qvel[worldid, k]
    own = zero
    for k in range(tree.dof_first[j], tree.dof_last[j] + 1):
        own += motion_in.cdof[worldid, k] * state_in.qvel[worldid, k]
    qvel_bar = qvel_bar - motion_cross_force(before, cacc_bar)

    axis = motion_in.cdof[worldid, j]
    # ∂/∂w_j of f·(X × S_j) w_j is S_j·(-X ×* f); displacement cotangents enter as S_j·X̄
    total = moved_bar - motion_cross_force(lam, lam_bar) - motion_cross_force(vel, qvel_bar)
    total = total - motion_cross_force(acc, cacc_bar) - motion_cross_force(pure, qacc_bar)
    total = total - motion_cross_force(mu, mu_bar) - motion_cross_force(excess, excess_bar)
    slope_q = wp.dot(axis, total) + slopes_in.qpos[worldid, j]
    # v enters as V_j ∋ S_j v_j and A_j ∋ Ṡ_j v_j
    slope_v = wp.dot(axis, qvel_bar - motion_cross_force(own, cacc_bar)) + wp.dot(
        motion_in.cdof_dot[worldid, j], cacc_bar
    )
    slope_v += slopes_in.qvel[worldid, j]

    lam_j = multipliers_in.lam[worldid, j]
    adr = springs.dof_spring_qpos[j]
    if adr >= 0:
        jnt = springs.dof_jntid[j]
        stretch = state_in.qpos[worldid, adr] - springs.qpos_spring[worldid % springs.qpos_spring.shape[0], adr]
        stiffness = springs.jnt_stiffness[worldid % springs.jnt_stiffness.shape[0], jnt]
        poly = springs.jnt_stiffnesspoly[worldid % springs.jnt_stiffnesspoly.shape[0], jnt]
        # Φ ∋ λ k(x) x with x = q - q₀
        slope_q += lam_j * poly_force_deriv(stiffness, poly, stretch, 0)
    if damper_on:
        c = damping_in[worldid, j]
        v = state_in.qvel[worldid, j]
        # Φ ∋ λ c(|v|) v
        slope_v += lam_j * poly_force_deriv(c[0], wp.vec2(c[1], c[2]), v, 1)
        if implicit_damping:
            # Φ ∋ h μ B(v) â with B = d(c v)/dv, hence dB/dv = sign(v) (2 c₁ + 6 c₂ |v|)
            h = opt_timestep[worldid % opt_timestep.shape[0]]
            bend = wp.sign(v) * (2.0 * c[1] + 6.0 * c[2] * wp.abs(v))
            slope_v += (
                h
                * multipliers_in.mu[worldid, j]
                * (state_in.qacc[worldid, j] - multipliers_in.excess[worldid, j])
                * bend
            )
    grad_qpos_out[worldid, j] = grad_qpos_out[worldid, j] - slope_q
    grad_qvel_out[worldid, j] = grad_qvel_out[worldid, j] - slope_v


class Bodies:
    """Launches of the sweeps down and up the tree."""

    def __init__(self, work: Workspace) -> None:
        self._work = work
        self._cacc_sum = wp.zeros((work.nworld, work.mjm.nbody), dtype=wp.spatial_vector)

    def launch_fields(self, at: Substep) -> None:
        """Launch the fields, and their cotangents as far as inertia and gravity give them."""
        work = self._work
        work.launch(body_fields, (work.nworld, work.model.nbody), at)

    def launch_sweep(self, at: Substep) -> None:
        """Launch the gradients of (qpos, qvel) from all cotangents."""
        work = self._work
        work.launch(close_velocity, (work.nworld, work.model.nbody), at, cacc_sum=self._cacc_sum)
        work.launch(sweep_up, (work.nworld, work.model.nv), at, cacc_sum=self._cacc_sum)
