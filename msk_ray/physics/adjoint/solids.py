"""Convex geoms as the adjoint of their contacts sees them: pose, size, and the flat faces of those that have any.

A box, a mesh (its convex hull), and the caps of a cylinder, which MuJoCo's convex collision takes as polygons of 16
corners, all have faces: an outward normal and corners in order around it. Everything here is local to the geom unless
it says otherwise.
"""

import warp as wp
from mujoco_warp import GeomType

from msk_ray.physics.adjoint.groups import Meshes

wp.set_module_options({"enable_backward": False})

CAP_CORNERS = wp.constant(16)
_CAP_STEP = wp.constant(0.39269908169872414)
"""Angle between two corners of a cylinder's cap, π/8."""


@wp.struct
class Solid:
    """One geom of a contact."""

    type: wp.int32
    pos: wp.vec3
    """Of its centre, in the world [m]."""
    mat: wp.mat33
    size: wp.vec3
    mesh: wp.int32
    """Index of its mesh, -1 for none."""


@wp.func
def into(solid: Solid, point: wp.vec3) -> wp.vec3:
    """A point of the world in the solid's coordinates."""
    return wp.transpose(solid.mat) @ (point - solid.pos)


@wp.func
def out_of(solid: Solid, point: wp.vec3) -> wp.vec3:
    """A point of the solid in the world's coordinates."""
    return solid.pos + solid.mat @ point


@wp.func
def has_corners(solid: Solid) -> bool:
    """Whether its surface consists of flat faces only."""
    return solid.type == GeomType.BOX or solid.type == GeomType.MESH


@wp.func
def face_count(solid: Solid, meshes: Meshes) -> int:
    """Number of flat faces."""
    count = int(0)
    if solid.type == GeomType.BOX:
        count = 6
    elif solid.type == GeomType.CYLINDER:
        count = 2
    elif solid.type == GeomType.MESH:
        count = meshes.mesh_polynum[solid.mesh]
    return count


@wp.func
def face_normal(solid: Solid, meshes: Meshes, face: int) -> wp.vec3:
    """Outward normal of a face."""
    normal = wp.vec3(0.0)
    if solid.type == GeomType.BOX:
        normal[face / 2] = wp.where(face % 2 == 0, 1.0, -1.0)
    elif solid.type == GeomType.CYLINDER:
        normal[2] = wp.where(face == 0, 1.0, -1.0)
    elif solid.type == GeomType.MESH:
        normal = meshes.mesh_polynormal[meshes.mesh_polyadr[solid.mesh] + face]
    return normal


@wp.func
def corner_count(solid: Solid, meshes: Meshes, face: int) -> int:
    """Number of a face's corners."""
    count = int(4)
    if solid.type == GeomType.CYLINDER:
        count = CAP_CORNERS
    elif solid.type == GeomType.MESH:
        count = meshes.mesh_polyvertnum[meshes.mesh_polyadr[solid.mesh] + face]
    return count


@wp.func
def face_corner(solid: Solid, meshes: Meshes, face: int, k: int) -> wp.vec3:
    """Corner `k` of a face; those of k and k + 1 are ends of one edge."""
    corner = wp.vec3(0.0)
    if solid.type == GeomType.BOX:
        axis = face / 2
        u = (axis + 1) % 3
        v = (axis + 2) % 3
        corner[axis] = wp.where(face % 2 == 0, solid.size[axis], -solid.size[axis])
        corner[u] = wp.where(k == 0 or k == 3, solid.size[u], -solid.size[u])
        corner[v] = wp.where(k < 2, solid.size[v], -solid.size[v])
    elif solid.type == GeomType.CYLINDER:
        angle = float(k) * _CAP_STEP
        side = wp.where(face == 0, solid.size[1], -solid.size[1])
        corner = wp.vec3(solid.size[0] * wp.cos(angle), solid.size[0] * wp.sin(angle), side)
    elif solid.type == GeomType.MESH:
        first = meshes.mesh_polyvertadr[meshes.mesh_polyadr[solid.mesh] + face]
        corner = meshes.mesh_vert[meshes.mesh_vertadr[solid.mesh] + meshes.mesh_polyvert[first + k]]
    return corner


@wp.func
def face_along(solid: Solid, meshes: Meshes, direction: wp.vec3) -> tuple[wp.int32, wp.float32]:
    """The face whose outward normal is nearest a unit direction of the world, and the sine of the angle; -1 for none.

    A face that looks the other way does not count.
    """
    local = wp.transpose(solid.mat) @ direction
    best = int(-1)
    cosine = float(0.0)
    for face in range(face_count(solid, meshes)):
        along = wp.dot(face_normal(solid, meshes, face), local)
        if along > cosine:
            cosine = along
            best = face
    sine = float(1.0)
    if best >= 0:
        sine = wp.length(wp.cross(face_normal(solid, meshes, best), local))
    return best, sine


@wp.func
def farthest(solid: Solid, meshes: Meshes, direction: wp.vec3) -> wp.vec3:
    """The solid's point that lies farthest along a unit direction, both in the world."""
    local = wp.transpose(solid.mat) @ direction
    size = solid.size
    point = wp.vec3(0.0)
    up = wp.where(local[2] >= 0.0, 1.0, -1.0)
    if solid.type == GeomType.SPHERE:
        point = size[0] * local
    elif solid.type == GeomType.CAPSULE:
        point = size[0] * local + wp.vec3(0.0, 0.0, up * size[1])
    elif solid.type == GeomType.ELLIPSOID:
        point = wp.cw_mul(size, wp.normalize(wp.cw_mul(size, local)))
    elif solid.type == GeomType.CYLINDER:
        point = size[0] * wp.normalize(wp.vec3(local[0], local[1], 0.0)) + wp.vec3(0.0, 0.0, up * size[1])
    elif solid.type == GeomType.BOX:
        for i in range(3):
            point[i] = wp.where(local[i] >= 0.0, size[i], -size[i])
    elif solid.type == GeomType.MESH:
        first = meshes.mesh_vertadr[solid.mesh]
        reach = float(-1.0e30)
        for k in range(meshes.mesh_vertnum[solid.mesh]):
            along = wp.dot(meshes.mesh_vert[first + k], local)
            if along > reach:
                reach = along
                point = meshes.mesh_vert[first + k]
    return out_of(solid, point)


@wp.func
def scale(solid: Solid) -> float:
    """A length of the order of the solid's size."""
    return wp.max(solid.size)
