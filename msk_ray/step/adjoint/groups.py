"""Arrays that kernels take together.

Axes: W worlds, nv degrees of freedom, B bodies, T tendons, R constraint rows, C contacts. A field of a group whose
array is mujoco_warp's has its name there, so that `gather` finds it.
"""

from collections.abc import Mapping
from typing import Any

import warp as wp

from msk_ray.step.forward.arrays import allocate as allocate
from msk_ray.step.forward.arrays import allocate_rows as allocate_rows
from msk_ray.step.forward.arrays import empty as empty
from msk_ray.step.forward.arrays import gather as gather
from msk_ray.step.forward.mjw_private import vec5, vec10


@wp.struct
class Joints:
    """Kind and addresses of every joint."""

    jnt_type: wp.array[int]
    jnt_qposadr: wp.array[int]
    jnt_dofadr: wp.array[int]


@wp.struct
class Springs:
    """Springs of joints; those of hinges and slides by dof."""

    dof_jntid: wp.array[int]
    dof_spring_qpos: wp.array[int]
    jnt_stiffness: wp.array2d[float]
    jnt_stiffnesspoly: wp.array2d[wp.vec2]
    qpos_spring: wp.array2d[float]


@wp.struct
class TendonRows:
    """Where each tendon's row of the tendon Jacobian lies."""

    ten_J_rownnz: wp.array[int]
    ten_J_rowadr: wp.array[int]
    ten_J_colind: wp.array[int]


@wp.struct
class Shapes:
    """Geoms and their bodies."""

    body_rootid: wp.array[int]
    geom_bodyid: wp.array[int]
    geom_type: wp.array[int]
    geom_size: wp.array2d[wp.vec3]


@wp.struct
class Meshes:
    """Convex hulls of meshes as polygons, and height fields."""

    geom_dataid: wp.array2d[int]
    mesh_vertadr: wp.array[int]
    mesh_vertnum: wp.array[int]
    mesh_vert: wp.array[wp.vec3]
    mesh_polynum: wp.array[int]
    mesh_polyadr: wp.array[int]
    mesh_polynormal: wp.array[wp.vec3]
    mesh_polyvertadr: wp.array[int]
    mesh_polyvertnum: wp.array[int]
    mesh_polyvert: wp.array[int]
    hfield_size: wp.array[wp.vec4]
    hfield_nrow: wp.array[int]
    hfield_ncol: wp.array[int]
    hfield_adr: wp.array[int]
    hfield_data: wp.array[float]


@wp.struct
class State:
    """State before the substep, and its acceleration."""

    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    qacc: wp.array2d[float]


@wp.struct
class Motion:
    """Twists and inertias of bodies and dofs, (W, B) or (W, nv)."""

    xipos: wp.array2d[wp.vec3]
    subtree_com: wp.array2d[wp.vec3]
    cdof: wp.array2d[wp.spatial_vector]
    cdof_dot: wp.array2d[wp.spatial_vector]
    cvel: wp.array2d[wp.spatial_vector]
    cinert: wp.array2d[vec10]


@wp.struct
class Rows:
    """What the pullback reads of constraint rows, (W, R)."""

    type: wp.array2d[int]
    id: wp.array2d[int]
    D: wp.array2d[float]
    aref: wp.array2d[float]
    frictionloss: wp.array2d[float]
    pos: wp.array2d[float]
    margin: wp.array2d[float]


@wp.struct
class Contacts:
    """What the pullback reads of the contacts of all worlds, (C,)."""

    dist: wp.array[float]
    pos: wp.array[wp.vec3]
    frame: wp.array[wp.mat33]
    includemargin: wp.array[float]
    friction: wp.array[vec5]
    solref: wp.array[wp.vec2]
    solreffriction: wp.array[wp.vec2]
    solimp: wp.array[vec5]
    dim: wp.array[int]
    geom: wp.array[wp.vec2i]
    efc_address: wp.array2d[int]
    worldid: wp.array[int]
    geomcollisionid: wp.array[int]


@wp.struct
class Multipliers:
    """What stays fixed in Φ besides a, (W, nv)."""

    lam: wp.array2d[float]
    """λ."""
    mu: wp.array2d[float]
    """μ."""
    excess: wp.array2d[float]
    """a - â."""


@wp.struct
class DofSlopes:
    """∂Φ/∂q and ∂Φ/∂v of what acts on dofs and not through bodies, (W, nv)."""

    qpos: wp.array2d[float]
    qvel: wp.array2d[float]


@wp.struct
class Fields:
    """Twists of all bodies, (W, B)."""

    lam: wp.array2d[wp.spatial_vector]
    """Under λ."""
    qacc: wp.array2d[wp.spatial_vector]
    """Under a."""
    cacc: wp.array2d[wp.spatial_vector]
    """Acceleration: under a, with velocity products and gravity."""
    mu: wp.array2d[wp.spatial_vector]
    """Under μ."""
    excess: wp.array2d[wp.spatial_vector]
    """Under a - â."""


@wp.struct
class FieldBars:
    """Cotangents of the fields, of the velocity (`qvel`) and of the body's displacement (`moved`), (W, B)."""

    lam: wp.array2d[wp.spatial_vector]
    qvel: wp.array2d[wp.spatial_vector]
    qacc: wp.array2d[wp.spatial_vector]
    cacc: wp.array2d[wp.spatial_vector]
    mu: wp.array2d[wp.spatial_vector]
    excess: wp.array2d[wp.spatial_vector]
    moved: wp.array2d[wp.spatial_vector]


@wp.struct
class TendonBars:
    """Cotangents of a tendon's length and of its rates under v, λ, a, μ and â, (W, T)."""

    length: wp.array2d[float]
    qvel: wp.array2d[float]
    lam: wp.array2d[float]
    qacc: wp.array2d[float]
    mu: wp.array2d[float]
    smooth: wp.array2d[float]


@wp.struct
class RowLaws:
    """J a - aref of every row, its force and minus the force's slope, (W, R)."""

    jar: wp.array2d[float]
    force: wp.array2d[float]
    slope: wp.array2d[float]


@wp.struct
class ContactBars:
    """Cotangents of a contact's distance, point and frame, (C,)."""

    dist: wp.array[float]
    pos: wp.array[wp.vec3]
    frame: wp.array[wp.mat33]


@wp.struct
class GeomGradients:
    """Gradients by geom, (W, G)."""

    geom_pos: wp.array2d[wp.vec3]
    geom_quat: wp.array2d[wp.vec4]
    geom_size: wp.array2d[wp.vec3]


@wp.struct
class TimestepGradient:
    """Gradient of the time step, (W,), to which every law that has one adds its part."""

    timestep: wp.array[float]


class Substep:
    """What stages read of a `mujoco_warp.Data`, grouped; everything else is in `data`.

    Args:
        gradients: groups of gradients of parameters that are wanted, by their types.

    Attributes:
        jacobian: the constraint Jacobian, a full matrix from `ConstraintLaws` on, shape (W, njmax, nv or more).
    """

    def __init__(self, data: Any, gradients: Mapping[Any, Any] | None = None) -> None:
        self.data = data
        self._gradients = gradients or {}
        self.state = gather(State, data)
        self.motion = gather(Motion, data)
        self.rows = gather(Rows, data.efc)
        self.contacts = gather(Contacts, data.contact)
        self.jacobian = data.efc.J

    def wants(self, *kinds: Any) -> bool:
        """Whether gradients of any of these groups are wanted."""
        return any(kind in self._gradients for kind in kinds)

    def gradient(self, kind: Any) -> Any:
        """The group of gradients of this type; its arrays have no size where they are not wanted."""
        return self._gradients[kind] if kind in self._gradients else empty(kind)
