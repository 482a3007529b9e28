"""Constraint rows that act on single degrees of freedom: joint limits."""

import warp as wp
from mujoco_warp._src.types import ConstraintType, vec5

from msk_ray.physics.adjoint.rows import row_slopes

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pull_limits(
    # Model:
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    jnt_dofadr: wp.array[int],
    jnt_solref: wp.array2d[wp.vec2],
    jnt_solimp: wp.array2d[vec5],
    # In:
    nefc_in: wp.array[int],
    type_in: wp.array2d[int],
    id_in: wp.array2d[int],
    jacobian_in: wp.array3d[float],
    pos_in: wp.array2d[float],
    margin_in: wp.array2d[float],
    force_in: wp.array2d[float],
    slope_in: wp.array2d[float],
    lam_in: wp.array2d[float],
    # Out:
    phi_qpos_out: wp.array2d[float],
    phi_qvel_out: wp.array2d[float],
):
    """Φ ∋ -ρ(λ) f(ρ(a) + b ρ(v) + k imp pos), ρ(x) = ±x_j and pos moving as ±q_j."""
    worldid, row = wp.tid()
    if row >= wp.min(nefc_in[worldid], slope_in.shape[1]):
        return
    if type_in[worldid, row] != ConstraintType.LIMIT_JOINT:
        return
    s = slope_in[worldid, row]
    if s == 0.0:
        return
    jnt = id_in[worldid, row]
    dof = jnt_dofadr[jnt]
    sign = jacobian_in[worldid, row, dof]
    pos = pos_in[worldid, row] - margin_in[worldid, row]
    slopes = row_slopes(
        opt_disableflags,
        opt_timestep[worldid % opt_timestep.shape[0]],
        jnt_solref[worldid % jnt_solref.shape[0], jnt],
        jnt_solimp[worldid % jnt_solimp.shape[0], jnt],
        pos,
    )
    rate = sign * lam_in[worldid, dof]
    # ∂Φ/∂jar = s ρ(λ)
    y = s * rate
    wp.atomic_add(phi_qvel_out, worldid, dof, sign * slopes.damping * y)
    pos_bar = slopes.stiffness * y - slopes.mass * rate * force_in[worldid, row]
    wp.atomic_add(phi_qpos_out, worldid, dof, sign * pos_bar)
