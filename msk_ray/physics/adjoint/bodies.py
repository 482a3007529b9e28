"""Twist fields of all bodies, and the tree sweep that turns cotangents of twists into cotangents of (q, v).

Notation: S_j is the unit twist of dof j, V_b(x) = Σ S_j x_j over the dofs that move body b. For a displacement w
of the configuration, a twist's change seen from its own body is

    δL_b = Σ_j (L_{<j} × S_j) w_j                                   (L, U: plain fields of λ and a)
    δV likewise;  δA_j = δA_{<j} + A_{<j} × S_j w_j + δV_j × S_j v_j   (A: accelerations with velocity products)

where `<j` is the field just before joint j (a ball's three dofs count as one joint). Inertias do not change seen
from their own body, so λᵀ(M a + bias) = Σ_b L·(I A + V ×* I V) needs nothing else.
"""

import warp as wp

from msk_ray.physics.adjoint.spatial import carried, wrench
from msk_ray.physics.mjw_private import inert_vec, motion_cross_force, poly_force_deriv, vec10

wp.set_module_options({"enable_backward": False})


@wp.kernel
def body_fields(
    # Model:
    opt_gravity: wp.array[wp.vec3],
    gravity_on: bool,
    body_lastdof: wp.array[int],
    body_rootid: wp.array[int],
    body_mass: wp.array2d[float],
    body_gravcomp: wp.array2d[float],
    dof_parentid: wp.array[int],
    # In:
    xipos_in: wp.array2d[wp.vec3],
    subtree_com_in: wp.array2d[wp.vec3],
    cdof_in: wp.array2d[wp.spatial_vector],
    cdof_dot_in: wp.array2d[wp.spatial_vector],
    cvel_in: wp.array2d[wp.spatial_vector],
    cinert_in: wp.array2d[vec10],
    qvel_in: wp.array2d[float],
    qacc_in: wp.array2d[float],
    lam_in: wp.array2d[float],
    mu_in: wp.array2d[float],
    excess_in: wp.array2d[float],
    # Out:
    lam_field_out: wp.array2d[wp.spatial_vector],
    qacc_field_out: wp.array2d[wp.spatial_vector],
    cacc_out: wp.array2d[wp.spatial_vector],
    mu_field_out: wp.array2d[wp.spatial_vector],
    excess_field_out: wp.array2d[wp.spatial_vector],
    lam_bar_out: wp.array2d[wp.spatial_vector],
    qvel_bar_out: wp.array2d[wp.spatial_vector],
    cacc_bar_out: wp.array2d[wp.spatial_vector],
    qacc_bar_out: wp.array2d[wp.spatial_vector],
    mu_bar_out: wp.array2d[wp.spatial_vector],
    excess_bar_out: wp.array2d[wp.spatial_vector],
    moved_bar_out: wp.array2d[wp.spatial_vector],
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
    j = body_lastdof[bodyid]
    while j >= 0:
        s = cdof_in[worldid, j]
        lam += s * lam_in[worldid, j]
        pure += s * qacc_in[worldid, j]
        bias += cdof_dot_in[worldid, j] * qvel_in[worldid, j]
        mu += s * mu_in[worldid, j]
        excess += s * excess_in[worldid, j]
        j = dof_parentid[j]
    acc = pure + bias
    lam_field_out[worldid, bodyid] = lam
    qacc_field_out[worldid, bodyid] = pure
    cacc_out[worldid, bodyid] = acc
    mu_field_out[worldid, bodyid] = mu
    excess_field_out[worldid, bodyid] = excess
    inertia = cinert_in[worldid, bodyid]
    vel = cvel_in[worldid, bodyid]
    momentum = inert_vec(inertia, vel)
    # ∂/∂L of L·(I A + V ×* I V)
    lam_bar_out[worldid, bodyid] = inert_vec(inertia, acc) + motion_cross_force(vel, momentum)
    # ∂/∂V: (δV ×* IV + V ×* I δV)·L = -δV·(L ×* IV) - δV·I(V × L)
    top = wp.spatial_top(vel)
    bottom = wp.spatial_bottom(vel)
    lam_top = wp.spatial_top(lam)
    crossed = wp.spatial_vector(
        wp.cross(top, lam_top), wp.cross(bottom, lam_top) + wp.cross(top, wp.spatial_bottom(lam))
    )
    qvel_bar_out[worldid, bodyid] = -motion_cross_force(lam, momentum) - inert_vec(inertia, crossed)
    # ∂/∂A = I L
    cacc_bar_out[worldid, bodyid] = inert_vec(inertia, lam)
    qacc_bar_out[worldid, bodyid] = zero
    # -μᵀM(a - â) = -Σ_b V_b(μ)·I V_b(a - â), bilinear in two plain fields
    mu_bar_out[worldid, bodyid] = -inert_vec(inertia, excess)
    excess_bar_out[worldid, bodyid] = -inert_vec(inertia, mu)
    moved = zero
    comp = body_gravcomp[worldid % body_gravcomp.shape[0], bodyid]
    if gravity_on and comp != 0.0:
        # Φ ∋ -u(λ)·F at the body's centre of mass, F = -gravity m comp fixed in the world
        mass = body_mass[worldid % body_mass.shape[0], bodyid]
        push = comp * mass * opt_gravity[worldid % opt_gravity.shape[0]]
        arm = xipos_in[worldid, bodyid] - subtree_com_in[worldid, body_rootid[bodyid]]
        along = wrench(push, wp.vec3(0.0), arm)
        lam_bar_out[worldid, bodyid] = lam_bar_out[worldid, bodyid] + along
        moved = carried(lam, along) + wrench(wp.cross(push, wp.spatial_top(lam)), wp.vec3(0.0), arm)
    moved_bar_out[worldid, bodyid] = moved


@wp.kernel
def close_velocity(
    # Model:
    body_subtree_end: wp.array[int],
    body_dofadr: wp.array[int],
    body_dofnum: wp.array[int],
    # In:
    cdof_in: wp.array2d[wp.spatial_vector],
    qvel_in: wp.array2d[float],
    cacc_bar_in: wp.array2d[wp.spatial_vector],
    # Out:
    cacc_sum_out: wp.array2d[wp.spatial_vector],
    qvel_bar_out: wp.array2d[wp.spatial_vector],
) -> None:
    """Σ of Ā over each subtree, and what δA_j ∋ δV_j × S_j v_j adds to V̄: (S_j v_j) ×* Σ Ā."""
    worldid, bodyid = wp.tid()
    total = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for b in range(bodyid, body_subtree_end[bodyid]):
        total += cacc_bar_in[worldid, b]
    cacc_sum_out[worldid, bodyid] = total
    own = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    start = body_dofadr[bodyid]
    for j in range(start, start + body_dofnum[bodyid]):
        own += cdof_in[worldid, j] * qvel_in[worldid, j]
    qvel_bar_out[worldid, bodyid] = qvel_bar_out[worldid, bodyid] + motion_cross_force(own, total)


@wp.kernel
def sweep_up(
    # Model:
    body_subtree_end: wp.array[int],
    body_parentid: wp.array[int],
    body_dofadr: wp.array[int],
    dof_bodyid: wp.array[int],
    dof_first: wp.array[int],
    dof_last: wp.array[int],
    dof_spring_qpos: wp.array[int],
    dof_jntid: wp.array[int],
    jnt_stiffness: wp.array2d[float],
    jnt_stiffnesspoly: wp.array2d[wp.vec2],
    qpos_spring: wp.array2d[float],
    damper_on: bool,
    implicit_damping: bool,
    opt_timestep: wp.array[float],
    # In:
    live_in: wp.array[int],
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    qacc_in: wp.array2d[float],
    lam_in: wp.array2d[float],
    mu_in: wp.array2d[float],
    excess_in: wp.array2d[float],
    damping_in: wp.array2d[wp.vec3],
    cdof_in: wp.array2d[wp.spatial_vector],
    cdof_dot_in: wp.array2d[wp.spatial_vector],
    cvel_in: wp.array2d[wp.spatial_vector],
    lam_field_in: wp.array2d[wp.spatial_vector],
    qacc_field_in: wp.array2d[wp.spatial_vector],
    cacc_in: wp.array2d[wp.spatial_vector],
    mu_field_in: wp.array2d[wp.spatial_vector],
    excess_field_in: wp.array2d[wp.spatial_vector],
    lam_bar_in: wp.array2d[wp.spatial_vector],
    qvel_bar_in: wp.array2d[wp.spatial_vector],
    cacc_sum_in: wp.array2d[wp.spatial_vector],
    qacc_bar_in: wp.array2d[wp.spatial_vector],
    mu_bar_in: wp.array2d[wp.spatial_vector],
    excess_bar_in: wp.array2d[wp.spatial_vector],
    moved_bar_in: wp.array2d[wp.spatial_vector],
    phi_qpos_in: wp.array2d[float],
    phi_qvel_in: wp.array2d[float],
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
    body = dof_bodyid[j]
    zero = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    lam_bar = zero
    qvel_bar = zero
    qacc_bar = zero
    moved_bar = zero
    mu_bar = zero
    excess_bar = zero
    for b in range(body, body_subtree_end[body]):
        lam_bar += lam_bar_in[worldid, b]
        qvel_bar += qvel_bar_in[worldid, b]
        qacc_bar += qacc_bar_in[worldid, b]
        moved_bar += moved_bar_in[worldid, b]
        mu_bar += mu_bar_in[worldid, b]
        excess_bar += excess_bar_in[worldid, b]
    cacc_bar = cacc_sum_in[worldid, body]

    # Fields just before this joint, and V̄ without what only joints before it (or it itself) feel.
    parent = body_parentid[body]
    lam = lam_field_in[worldid, parent]
    pure = qacc_field_in[worldid, parent]
    acc = cacc_in[worldid, parent]
    vel = cvel_in[worldid, parent]
    mu = mu_field_in[worldid, parent]
    excess = excess_field_in[worldid, parent]
    before = zero
    start = body_dofadr[body]
    for k in range(start, dof_first[j]):
        s = cdof_in[worldid, k]
        lam += s * lam_in[worldid, k]
        pure += s * qacc_in[worldid, k]
        acc += s * qacc_in[worldid, k] + cdof_dot_in[worldid, k] * qvel_in[worldid, k]
        vel += s * qvel_in[worldid, k]
        mu += s * mu_in[worldid, k]
        excess += s * excess_in[worldid, k]
        before += s * qvel_in[worldid, k]
    own = zero
    for k in range(dof_first[j], dof_last[j] + 1):
        own += cdof_in[worldid, k] * qvel_in[worldid, k]
    qvel_bar = qvel_bar - motion_cross_force(before, cacc_bar)

    axis = cdof_in[worldid, j]
    # ∂/∂w_j of f·(X × S_j) w_j is S_j·(-X ×* f); displacement cotangents enter as S_j·X̄
    total = moved_bar - motion_cross_force(lam, lam_bar) - motion_cross_force(vel, qvel_bar)
    total = total - motion_cross_force(acc, cacc_bar) - motion_cross_force(pure, qacc_bar)
    total = total - motion_cross_force(mu, mu_bar) - motion_cross_force(excess, excess_bar)
    slope_q = wp.dot(axis, total) + phi_qpos_in[worldid, j]
    # v enters as V_j ∋ S_j v_j and A_j ∋ Ṡ_j v_j
    slope_v = wp.dot(axis, qvel_bar - motion_cross_force(own, cacc_bar)) + wp.dot(cdof_dot_in[worldid, j], cacc_bar)
    slope_v += phi_qvel_in[worldid, j]

    lam_j = lam_in[worldid, j]
    adr = dof_spring_qpos[j]
    if adr >= 0:
        jnt = dof_jntid[j]
        stretch = qpos_in[worldid, adr] - qpos_spring[worldid % qpos_spring.shape[0], adr]
        stiffness = jnt_stiffness[worldid % jnt_stiffness.shape[0], jnt]
        poly = jnt_stiffnesspoly[worldid % jnt_stiffnesspoly.shape[0], jnt]
        # Φ ∋ λ k(x) x with x = q - q₀
        slope_q += lam_j * poly_force_deriv(stiffness, poly, stretch, 0)
    if damper_on:
        c = damping_in[worldid, j]
        v = qvel_in[worldid, j]
        # Φ ∋ λ c(|v|) v
        slope_v += lam_j * poly_force_deriv(c[0], wp.vec2(c[1], c[2]), v, 1)
        if implicit_damping:
            # Φ ∋ h μ B(v) â with B = d(c v)/dv, hence dB/dv = sign(v) (2 c₁ + 6 c₂ |v|)
            h = opt_timestep[worldid % opt_timestep.shape[0]]
            bend = wp.sign(v) * (2.0 * c[1] + 6.0 * c[2] * wp.abs(v))
            slope_v += h * mu_in[worldid, j] * (qacc_in[worldid, j] - excess_in[worldid, j]) * bend
    grad_qpos_out[worldid, j] = grad_qpos_out[worldid, j] - slope_q
    grad_qvel_out[worldid, j] = grad_qvel_out[worldid, j] - slope_v
