"""What the adjoint takes from inside mujoco_warp; after an upgrade these tests name what changed."""

import inspect
import re
from hashlib import blake2b
from pathlib import Path
from typing import get_args, get_origin

import mujoco
import pytest
import warp as wp

from msk_ray.step.forward import mjw_private

DAMPING = (
    "{}_damping array2d[float32], {}_dampingpoly array2d[vec2f], actuator_trntype array1d[int32], "
    "actuator_trnid array1d[vec2i], actuator_damping array2d[float32], actuator_dampingpoly array2d[vec2f], "
    "actuator_gear array2d[spatial_vectorf], worldid int"
)
SIGNATURES = {
    "capsule_capsule": "cap1_pos vec3f, cap1_axis vec3f, cap1_radius float, cap1_half_length float, cap2_pos vec3f, "
    "cap2_axis vec3f, cap2_radius float, cap2_half_length float -> (vec2f, mat23f, mat23f)",
    "deriv_expmap": "expmap vec3f, vel vec3f -> vec3f",
    "dof_damping_total": "jnt_actuatorid array1d[int32], dof_jntid array1d[int32], "
    + DAMPING.format("dof", "dof")
    + ", dofid int -> (float, vec2f)",
    "inert_vec": "i vec10f, v spatial_vectorf -> spatial_vectorf",
    "lu_factor_6x6": "A_in mat66f -> (mat66f, vec6i, bool)",
    "lu_solve_6x6": "A_in mat66f, pivot_in vec6i, b_in vec6f -> vec6f",
    "make_frame": "a vec3f -> ?",
    "motion_cross_force": "v spatial_vectorf, f spatial_vectorf -> spatial_vectorf",
    "mul_quat": "u quatf, v quatf -> quatf",
    "muscle_bias": "len float, lengthrange vec2f, acc0 float, prm vec10f -> float",
    "muscle_dynamics": "control float, activation float, prm vec10f -> float",
    "muscle_gain": "len float, vel float, lengthrange vec2f, acc0 float, prm vec10f -> float",
    "muscle_gain_vel_deriv": "len float, vel float, lengthrange vec2f, acc0 float, prm vec10f -> float",
    "plane_cylinder": "plane_normal vec3f, plane_pos vec3f, cylinder_center vec3f, cylinder_axis vec3f, "
    "cylinder_radius float, cylinder_half_height float -> (vec4f, mat43f, vec3f)",
    "plane_ellipsoid": "plane_normal vec3f, plane_pos vec3f, ellipsoid_pos vec3f, ellipsoid_rot mat33f, "
    "ellipsoid_size vec3f -> (float, vec3f, vec3f)",
    "plane_sphere": "plane_normal vec3f, plane_pos vec3f, sphere_pos vec3f, sphere_radius float -> (float, vec3f)",
    "poly_force": "linear float, poly vec2f, x float, flg_odd int -> float",
    "poly_force_deriv": "linear float, poly vec2f, x float, flg_odd int -> float",
    "quat_integrate": "q quatf, v vec3f, dt float -> quatf",
    "quat_sub": "qa quatf, qb quatf -> vec3f",
    "quat_to_mat": "quat quatf -> mat33f",
    "quat_to_vel": "quat quatf -> vec3f",
    "ray_geom": "pos vec3f, mat mat33f, size vec3f, pnt vec3f, vec vec3f, geomtype int -> (float, vec3f)",
    "ray_hfield": "geom_dataid array2d[int32], hfield_size array1d[vec4f], hfield_nrow array1d[int32], "
    "hfield_ncol array1d[int32], hfield_adr array1d[int32], hfield_data array1d[float32], pos vec3f, mat mat33f, "
    "pnt vec3f, vec vec3f, id int, worldid int -> (float, vec3f)",
    "ray_mesh": "nmeshface int, mesh_vertadr array1d[int32], mesh_faceadr array1d[int32], mesh_vert array1d[vec3f], "
    "mesh_face array1d[vec3i], data_id int, pos vec3f, mat mat33f, size vec3f, pnt vec3f, vec vec3f "
    "-> (float, vec3f)",
    "safe_div": "x Any, y Any -> Any",
    "sphere_box": "sphere_pos vec3f, sphere_radius float, box_pos vec3f, box_rot mat33f, box_size vec3f "
    "-> (float, vec3f, vec3f)",
    "sphere_capsule": "sphere_pos vec3f, sphere_radius float, capsule_pos vec3f, capsule_axis vec3f, "
    "capsule_radius float, capsule_half_length float -> (float, vec3f, vec3f)",
    "sphere_sphere": "pos1 vec3f, radius1 float, pos2 vec3f, radius2 float -> (float, vec3f, vec3f)",
    "tendon_damping_total": "tendon_actuatorid array1d[int32], "
    + DAMPING.format("tendon", "tendon")
    + ", tenid int -> (float, vec2f)",
    "wrap": "x0 vec3f, x1 vec3f, pos vec3f, mat mat33f, radius float, geomtype int, side vec3f "
    "-> (float, vec3f, vec3f)",
}
MEMBERS = {
    "ConstraintType": {
        "EQUALITY": mujoco.mjtConstraint.mjCNSTR_EQUALITY,
        "FRICTION_DOF": mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF,
        "FRICTION_TENDON": mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON,
        "LIMIT_JOINT": mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT,
        "LIMIT_TENDON": mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON,
        "CONTACT_FRICTIONLESS": mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS,
        "CONTACT_ELLIPTIC": mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC,
    },
    "ConstraintState": {
        name: getattr(mujoco.mjtConstraintState, f"mjCNSTRSTATE_{name}")
        for name in ("SATISFIED", "QUADRATIC", "LINEARNEG", "LINEARPOS", "CONE")
    },
    "EqType": {
        "CONNECT": mujoco.mjtEq.mjEQ_CONNECT,
        "WELD": mujoco.mjtEq.mjEQ_WELD,
        "JOINT": mujoco.mjtEq.mjEQ_JOINT,
        "TENDON": mujoco.mjtEq.mjEQ_TENDON,
    },
    "WrapType": {
        "JOINT": mujoco.mjtWrap.mjWRAP_JOINT,
        "SPHERE": mujoco.mjtWrap.mjWRAP_SPHERE,
        "CYLINDER": mujoco.mjtWrap.mjWRAP_CYLINDER,
    },
}
# Functions and kernels around which `physics.ordered` builds stages of its own: all of their text counts.
SOURCES: dict[str, str] = {
    "actuator_velocity_slopes": "e48909bc9b681b60",
    "cholesky_factorize_solve": "2a5ee35790e5f9c4",
    "create_solver_context": "e10a84bfd7dfcf18",
    "init_context": "f6184b56c9f0a494",
    "linesearch": "7502603d6db16da8",
    "padding_h": "0f9a31a6658b93cb",
    "skip_qacc_smooth": "f6203dd679cfb96f",
    "solve_done": "4dc564de5f7ede40",
    "solve_init_dof": "b7e4ec537f9f8f3b",
    "update_constraint": "f1c7bfe90dff1ce3",
    "update_gradient_JTDAJ_dense_tiled": "e48b8eb0af0fb8e8",
    "update_gradient_zero_grad_dot": "82b87977f3aa34ff",
}
NUMBERS = {
    "BLOCK_CHOLESKY_DIM": 32,
    "MJ_MAXVAL": mujoco.mjMAXVAL,
    "MJ_MINVAL": mujoco.mjMINVAL,
    "TILE_SIZE_JTDAJ_DENSE": 16,
}
SHAPES = {"vec5": (5,), "vec6": (6,), "vec10": (10,), "vec12": (12,), "mat66": (6, 6)}


def spelled(kind: object) -> str:
    """A type as the table above writes it."""
    if kind is inspect.Parameter.empty:
        return "?"
    if get_origin(kind) is tuple:
        return f"({', '.join(spelled(part) for part in get_args(kind))})"
    if hasattr(kind, "ndim") and hasattr(kind, "dtype"):
        return f"array{kind.ndim}d[{spelled(kind.dtype)}]"
    return kind.__name__


@pytest.mark.parametrize("name", sorted(SIGNATURES))
def test_a_function_takes_and_gives_what_it_did(name: str) -> None:
    signature = inspect.signature(getattr(mjw_private, name).func)
    takes = ", ".join(f"{key} {spelled(p.annotation)}" for key, p in signature.parameters.items())
    assert f"{takes} -> {spelled(signature.return_annotation)}" == SIGNATURES[name]


@pytest.mark.parametrize("name", sorted(MEMBERS))
def test_members_are_those_of_c_mujoco(name: str) -> None:
    kind = getattr(mjw_private, name)
    assert {key: int(kind[key]) for key in MEMBERS[name]} == {key: int(v) for key, v in MEMBERS[name].items()}


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_vectors_and_matrices_are_as_large(name: str) -> None:
    kind = getattr(mjw_private, name)
    assert (kind._shape_, kind._wp_scalar_type_) == (SHAPES[name], wp.float32)


@pytest.mark.parametrize("name", sorted(NUMBERS))
def test_numbers_are_what_they_were(name: str) -> None:
    assert getattr(mjw_private, name) == NUMBERS[name]


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_the_solver_reads_as_it_did(name: str) -> None:
    assert text_digest(getattr(mjw_private, name)) == SOURCES[name]


def text_digest(thing: object) -> str:
    """A digest of a function's or kernel's source text."""
    function = inspect.unwrap(getattr(thing, "func", thing))
    return blake2b(inspect.getsource(function).encode(), digest_size=8).hexdigest()


def test_every_private_name_is_checked() -> None:
    assert sorted([*SIGNATURES, *MEMBERS, *SHAPES, *SOURCES, *NUMBERS]) == sorted(mjw_private.__all__)


def test_private_names_come_from_one_module(root: Path) -> None:
    inside = re.compile(r"mujoco_warp\._src|mjw\._src")
    found = [p.relative_to(root) for p in (root / "msk_ray").rglob("*.py") if inside.search(p.read_text())]
    assert found == [Path("msk_ray/step/forward/mjw_private.py")]


def test_members_that_kernels_use_are_checked(root: Path) -> None:
    """A member the table lacks would go unnoticed."""
    for name, members in MEMBERS.items():
        uses = re.compile(rf"\b{name}\.([A-Z_]+)")
        used = {m for p in (root / "msk_ray" / "step").rglob("*.py") for m in uses.findall(p.read_text())}
        assert used == set(members), name
