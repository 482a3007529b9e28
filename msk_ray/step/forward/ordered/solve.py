"""mujoco_warp's Newton solver with its two unordered sums, |gradient|² and the Hessian of cones, in a fixed order.

The loop is the one of `solver._solve` in mujoco_warp 4.0.0 for a dense Jacobian, without its incremental update of the
Hessian for pyramids, which adds rows in the order of atomics: here the Hessian is rebuilt in every iteration, as
mujoco_warp itself does for elliptic cones.
"""

from typing import Any

import mujoco_warp as mjw
import warp as wp

from msk_ray.step.forward import mjw_private as private
from msk_ray.step.forward.mjw_private import ConstraintType, safe_div, vec5

wp.set_module_options({"enable_backward": False})

_CONE = wp.constant(int(private.ConstraintState.CONE))
_MIN = wp.constant(float(private.MJ_MINVAL))


@wp.kernel
def gradient(
    # In:
    qfrc_smooth_in: wp.array2d[float],
    qfrc_constraint_in: wp.array2d[float],
    inertial_in: wp.array2d[float],
    done_in: wp.array[bool],
    # Out:
    gradient_out: wp.array2d[float],
    square_out: wp.array[float],
) -> None:
    """Compute Ma - τ - Jᵀf of every dof; the first dof's thread sums all squares in order."""
    worldid, dof = wp.tid()
    if done_in[worldid]:
        return
    gradient_out[worldid, dof] = (
        inertial_in[worldid, dof] - qfrc_smooth_in[worldid, dof] - qfrc_constraint_in[worldid, dof]
    )
    if dof == 0:
        total = float(0.0)
        for i in range(qfrc_smooth_in.shape[1]):
            value = inertial_in[worldid, i] - qfrc_smooth_in[worldid, i] - qfrc_constraint_in[worldid, i]
            total += value * value
        square_out[worldid] = total


@wp.kernel
def cone_hessian(
    # Model:
    opt_impratio_invsqrt: wp.array[float],
    dof_tri_row: wp.array[int],
    dof_tri_col: wp.array[int],
    # In:
    first_in: wp.array[int],
    nl_in: wp.array[int],
    nf_in: wp.array[int],
    nefc_in: wp.array[int],
    njmax: int,
    type_in: wp.array2d[int],
    id_in: wp.array2d[int],
    state_in: wp.array2d[int],
    mass_in: wp.array2d[float],
    jacobian_in: wp.array3d[float],
    jar_in: wp.array2d[float],
    friction_in: wp.array[vec5],
    dim_in: wp.array[int],
    done_in: wp.array[bool],
    # Out:
    hessian_out: wp.array3d[float],
) -> None:
    """Add the curvature of sliding contacts to one entry of a world's Hessian, contact by contact.

    With N = μ jar₀, uᵢ = φᵢ jarᵢ, T = |u|, z₀ = μ J₀, zᵢ = φᵢ Jᵢ, p = u·z / T and Dm = D₀ / (μ²(1 + μ²)):
    Dm (z₀ z₀' - μ (z₀ p' + z₀' p) + (μ N / T) p p' + (μ² - μ N / T) Σ zᵢ zᵢ').
    """
    worldid, entry = wp.tid()
    if done_in[worldid]:
        return
    dof1 = dof_tri_row[entry]
    dof2 = dof_tri_col[entry]
    impratio = opt_impratio_invsqrt[worldid % opt_impratio_invsqrt.shape[0]]
    total = hessian_out[worldid, dof1, dof2]
    row = first_in[worldid] + nf_in[worldid] + nl_in[worldid]
    count = wp.min(nefc_in[worldid], njmax)
    while row < count:
        if type_in[worldid, row] != int(ConstraintType.CONTACT_ELLIPTIC):
            row += 1
            continue
        con = id_in[worldid, row]
        dim = dim_in[con]
        if state_in[worldid, row] == _CONE and row + dim <= count:
            friction = friction_in[con]
            mu = friction[0] * impratio
            mu2 = mu * mu
            dm = safe_div(mass_in[worldid, row], mu2 * (1.0 + mu2))
            z01 = mu * jacobian_in[worldid, row, dof1]
            z02 = mu * jacobian_in[worldid, row, dof2]
            squares = float(0.0)
            p1 = float(0.0)
            p2 = float(0.0)
            tangent = float(0.0)
            for i in range(1, dim):
                scale = friction[i - 1]
                u = jar_in[worldid, row + i] * scale
                z1 = scale * jacobian_in[worldid, row + i, dof1]
                z2 = scale * jacobian_in[worldid, row + i, dof2]
                squares += u * u
                p1 += u * z1
                p2 += u * z2
                tangent += z1 * z2
            inverse = safe_div(1.0, wp.max(wp.sqrt(squares), _MIN))
            p1 = p1 * inverse
            p2 = p2 * inverse
            ratio = mu * (jar_in[worldid, row] * mu) * inverse
            total += dm * (z01 * z02 - mu * (z01 * p2 + z02 * p1) + ratio * p1 * p2 + (mu2 - ratio) * tangent)
        row += dim
    hessian_out[worldid, dof1, dof2] = total


def _direction(m: Any, d: Any, context: Any) -> None:
    """Launch gradient, Hessian and Newton direction at the current acceleration."""
    wp.launch(
        private.update_gradient_zero_grad_dot(False),
        dim=d.nworld,
        inputs=[d.nefc, context.alpha, context.done],
        outputs=[context.grad_dot, context.newton_decrement, context.grad_scale, context.search_unchanged],
    )
    wp.launch(
        gradient,
        dim=(d.nworld, m.nv),
        inputs=[d.qfrc_smooth, d.qfrc_constraint, d.efc.Ma, context.done],
        outputs=[context.grad, context.grad_dot],
    )
    wp.launch_tiled(
        private.update_gradient_JTDAJ_dense_tiled(
            m.nv_pad, private.TILE_SIZE_JTDAJ_DENSE, d.njmax, m.M_colind.shape[0]
        ),
        dim=d.nworld,
        inputs=[m.M_colind, m.M_hinit_i, d.nefc, d.M, d.efc.J, d.efc.D, d.efc.state, context.done],
        outputs=[context.h],
        block_dim=m.block_dim.update_gradient_JTDAJ_dense,
    )
    if m.nv > private.BLOCK_CHOLESKY_DIM:
        wp.launch(private.padding_h, dim=(d.nworld, m.nv_pad - m.nv), inputs=[m.nv, context.done], outputs=[context.h])
    if m.opt.cone == mjw.ConeType.ELLIPTIC:
        wp.launch(
            cone_hessian,
            dim=(d.nworld, m.dof_tri_row.size),
            inputs=[
                *(m.opt.impratio_invsqrt, m.dof_tri_row, m.dof_tri_col, d.ne, d.nl, d.nf, d.nefc, d.njmax),
                *(d.efc.type, d.efc.id, d.efc.state, d.efc.D, d.efc.J, context.Jaref),
                *(d.contact.friction, d.contact.dim, context.done),
            ],
            outputs=[context.h],
        )
    private.cholesky_factorize_solve(m, d, context)


def _iteration(m: Any, d: Any, context: Any, nsolving: wp.array) -> None:
    private.linesearch(m, d, context)
    private.update_constraint(m, d, context)
    _direction(m, d, context)
    wp.launch(
        private.solve_done(0),
        dim=d.nworld,
        inputs=[
            *(m.opt.tolerance, m.opt.iterations, context.inertia_scale, context.grad_dot, context.newton_decrement),
            *(context.improvement, context.alpha, context.done),
        ],
        outputs=[d.solver_niter, d.overflow, nsolving, context.done],
    )


def solve(m: Any, d: Any) -> None:
    """Launch the equivalent of `mujoco_warp.solve` for the Newton solver, on sorted rows."""
    if d.njmax == 0 or m.nv == 0:
        mjw.solve(m, d)
        return
    context = private.create_solver_context(m, d, inplace_cholesky=True)
    warm = not (m.opt.disableflags & mjw.DisableBit.WARMSTART)
    wp.launch(
        private.solve_init_dof(warm, False, not private.skip_qacc_smooth(m, d)),
        dim=(d.nworld, m.nv),
        inputs=[d.nefc, d.qacc_warmstart, d.qacc_smooth],
        outputs=[d.qacc, d.qfrc_constraint],
    )
    private.init_context(m, d, context, grad=False)
    _direction(m, d, context)
    nsolving = wp.full(shape=(1,), value=d.nworld, dtype=int)
    if m.opt.iterations != 0 and m.opt.graph_conditional:
        wp.capture_while(nsolving, while_body=_iteration, m=m, d=d, context=context, nsolving=nsolving)
    else:
        for _ in range(m.opt.iterations):
            _iteration(m, d, context, nsolving)
