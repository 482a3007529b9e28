"""Every private name of mujoco_warp that the package uses, imported only here.

`mujoco_warp._src` may change in any release. A test checks each name's signature, members or size, so that a release
that changes one fails by that name, before any gradient is wrong. Public names are imported from `mujoco_warp` where
they are used.
"""

from mujoco_warp._src.collision_primitive_core import (
    capsule_capsule,
    plane_cylinder,
    plane_ellipsoid,
    plane_sphere,
    sphere_box,
    sphere_capsule,
    sphere_sphere,
)
from mujoco_warp._src.derivative import _qderiv_actuator_passive_vel as actuator_velocity_slopes
from mujoco_warp._src.math import (
    deriv_expmap,
    inert_vec,
    lu_factor_6x6,
    lu_solve_6x6,
    make_frame,
    motion_cross_force,
    mul_quat,
    quat_integrate,
    quat_sub,
    quat_to_mat,
    quat_to_vel,
    safe_div,
)
from mujoco_warp._src.ray import ray_geom, ray_hfield, ray_mesh
from mujoco_warp._src.smooth import skip_qacc_smooth
from mujoco_warp._src.solver import _BLOCK_CHOLESKY_DIM as BLOCK_CHOLESKY_DIM
from mujoco_warp._src.solver import _cholesky_factorize_solve as cholesky_factorize_solve
from mujoco_warp._src.solver import _create_solver_context as create_solver_context
from mujoco_warp._src.solver import _linesearch as linesearch
from mujoco_warp._src.solver import _padding_h as padding_h
from mujoco_warp._src.solver import _solve_done as solve_done
from mujoco_warp._src.solver import _solve_init_dof as solve_init_dof
from mujoco_warp._src.solver import _update_constraint as update_constraint
from mujoco_warp._src.solver import _update_gradient_JTDAJ_dense_tiled as update_gradient_JTDAJ_dense_tiled
from mujoco_warp._src.solver import _update_gradient_zero_grad_dot as update_gradient_zero_grad_dot
from mujoco_warp._src.solver import init_context
from mujoco_warp._src.types import (
    MJ_MAXVAL,
    MJ_MINVAL,
    TILE_SIZE_JTDAJ_DENSE,
    ConstraintState,
    ConstraintType,
    EqType,
    WrapType,
    mat66,
    vec5,
    vec6,
    vec10,
    vec12,
)
from mujoco_warp._src.util_misc import _poly_force as poly_force
from mujoco_warp._src.util_misc import _poly_force_deriv as poly_force_deriv
from mujoco_warp._src.util_misc import (
    dof_damping_total,
    muscle_bias,
    muscle_dynamics,
    muscle_gain,
    muscle_gain_vel_deriv,
    tendon_damping_total,
    wrap,
)

__all__ = [
    "BLOCK_CHOLESKY_DIM",
    "MJ_MAXVAL",
    "MJ_MINVAL",
    "TILE_SIZE_JTDAJ_DENSE",
    "ConstraintState",
    "ConstraintType",
    "EqType",
    "WrapType",
    "actuator_velocity_slopes",
    "capsule_capsule",
    "cholesky_factorize_solve",
    "create_solver_context",
    "deriv_expmap",
    "dof_damping_total",
    "inert_vec",
    "init_context",
    "linesearch",
    "lu_factor_6x6",
    "lu_solve_6x6",
    "make_frame",
    "mat66",
    "motion_cross_force",
    "mul_quat",
    "muscle_bias",
    "muscle_dynamics",
    "muscle_gain",
    "muscle_gain_vel_deriv",
    "padding_h",
    "plane_cylinder",
    "plane_ellipsoid",
    "plane_sphere",
    "poly_force",
    "poly_force_deriv",
    "quat_integrate",
    "quat_sub",
    "quat_to_mat",
    "quat_to_vel",
    "ray_geom",
    "ray_hfield",
    "ray_mesh",
    "safe_div",
    "skip_qacc_smooth",
    "solve_done",
    "solve_init_dof",
    "sphere_box",
    "sphere_capsule",
    "sphere_sphere",
    "tendon_damping_total",
    "update_constraint",
    "update_gradient_JTDAJ_dense_tiled",
    "update_gradient_zero_grad_dot",
    "vec5",
    "vec6",
    "vec10",
    "vec12",
    "wrap",
]
