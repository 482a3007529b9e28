"""Every private name of mujoco_warp that the package uses, imported here and nowhere else.

`mujoco_warp._src` promises nothing between releases. A test holds each name to its signature, members or size, so that
a release that changes one fails by that name, before any gradient does. Public names are imported from `mujoco_warp`
where they are used.
"""

from mujoco_warp._src.collision_primitive_core import (
    capsule_capsule,
    plane_ellipsoid,
    plane_sphere,
    sphere_box,
    sphere_capsule,
    sphere_sphere,
)
from mujoco_warp._src.constraint import _contact_kbimp as contact_kbimp
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
from mujoco_warp._src.types import MJ_MAXVAL, ConstraintType, EqType, WrapType, mat66, vec5, vec6, vec10, vec12
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
    "MJ_MAXVAL",
    "ConstraintType",
    "EqType",
    "WrapType",
    "capsule_capsule",
    "contact_kbimp",
    "deriv_expmap",
    "dof_damping_total",
    "inert_vec",
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
    "plane_ellipsoid",
    "plane_sphere",
    "poly_force",
    "poly_force_deriv",
    "quat_integrate",
    "quat_sub",
    "quat_to_mat",
    "quat_to_vel",
    "safe_div",
    "sphere_box",
    "sphere_capsule",
    "sphere_sphere",
    "tendon_damping_total",
    "vec5",
    "vec6",
    "vec10",
    "vec12",
    "wrap",
]
