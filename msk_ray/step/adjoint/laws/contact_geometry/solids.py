"""Convex geoms as the adjoint of their contacts sees them: pose, size, and the flat faces of those that have any.

A box, a mesh (its convex hull), the caps of a cylinder, which MuJoCo's convex collision takes as polygons of 16
corners, and a height field near a contact have faces: an outward normal and corners in order around it. Everything
here is local to the geom unless it says otherwise.
"""

import warp as wp
from mujoco_warp import GeomType

from msk_ray.step.adjoint.groups import Meshes
from msk_ray.step.adjoint.laws.contact_geometry.height_fields import (
    WINDOW_FACES,
    triangle_corner,
    triangle_normal,
    window_at,
)

wp.set_module_options({"enable_backward": False})

CAP_CORNERS = wp.constant(16)
_CAP_STEP = wp.constant(0.39269908169872414)
"""Angle between two corners of a cylinder's cap, π/8."""

_TIED = wp.constant(1.0e-4)
"""Difference of two corners' places along a direction, in sizes, below which they tie."""
_OFF = wp.constant(1.0e-3)
"""Distance of a point, in sizes, above which it is not on a height field's face."""


@wp.struct
class Solid:
    """One geom of a contact."""

    type: wp.int32
    pos: wp.vec3
    """Of its centre, in the world [m]."""
    mat: wp.mat33
    size: wp.vec3
    """MuJoCo's, but of a height field that of a cell [m]."""
    mesh: wp.int32
    """Index of its mesh or height field, -1 for none."""
    row: wp.int32
    """Of a height field: the first row of the cells that count."""
    column: wp.int32
    near: wp.vec3
    """Of a height field: the point that its faces have to pass."""


@wp.func
def into(solid: Solid, point: wp.vec3) -> wp.vec3:
    """A point of the world in the solid's coordinates."""
    return wp.transpose(solid.mat) @ (point - solid.pos)


@wp.func
def looked_at(field: Solid, meshes: Meshes, point: wp.vec3) -> Solid:
    """A height field's faces near a point of the world."""
    solid = field
    extent = meshes.hfield_size[solid.mesh]
    width = 2.0 * extent[0] / float(meshes.hfield_ncol[solid.mesh] - 1)
    solid.size = wp.vec3(width, 2.0 * extent[1] / float(meshes.hfield_nrow[solid.mesh] - 1), 0.0)
    solid.near = into(solid, point)
    row, column = window_at(solid.mesh, meshes, solid.near)
    solid.row = row
    solid.column = column
    return solid


@wp.func
def out_of(solid: Solid, point: wp.vec3) -> wp.vec3:
    """A point of the solid in the world's coordinates."""
    return solid.pos + solid.mat @ point


@wp.func
def has_corners(solid: Solid) -> bool:
    """Whether its surface consists of flat faces only."""
    return solid.type == GeomType.BOX or solid.type == GeomType.MESH or solid.type == GeomType.HFIELD


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
    elif solid.type == GeomType.HFIELD:
        count = WINDOW_FACES
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
    elif solid.type == GeomType.HFIELD:
        normal = triangle_normal(solid.mesh, solid.row, solid.column, meshes, face)
    return normal


@wp.func
def corner_count(solid: Solid, meshes: Meshes, face: int) -> int:
    """Number of a face's corners."""
    count = int(4)
    if solid.type == GeomType.CYLINDER:
        count = CAP_CORNERS
    elif solid.type == GeomType.MESH:
        count = meshes.mesh_polyvertnum[meshes.mesh_polyadr[solid.mesh] + face]
    elif solid.type == GeomType.HFIELD:
        count = 3
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
    elif solid.type == GeomType.HFIELD:
        corner = triangle_corner(solid.mesh, solid.row, solid.column, meshes, face, k)
    return corner


@wp.func
def is_off(solid: Solid, meshes: Meshes, face: int, normal: wp.vec3) -> bool:
    """Whether a face of a height field lies off the point where it is touched; its faces may have equal normals."""
    off = bool(False)
    if solid.type == GeomType.HFIELD:
        height = wp.dot(normal, solid.near - face_corner(solid, meshes, face, 0))
        off = wp.abs(height) > _OFF * wp.max(solid.size)
    return off


@wp.func
def face_along(solid: Solid, meshes: Meshes, direction: wp.vec3) -> tuple[wp.int32, wp.float32]:
    """The face whose outward normal is nearest a unit direction of the world, and the sine of the angle; -1 for none.

    A face that looks the other way does not count.
    """
    local = wp.transpose(solid.mat) @ direction
    best = int(-1)
    cosine = float(0.0)
    for face in range(face_count(solid, meshes)):
        normal = face_normal(solid, meshes, face)
        along = wp.dot(normal, local)
        if along > cosine and not is_off(solid, meshes, face, normal):
            cosine = along
            best = face
    sine = float(1.0)
    if best >= 0:
        sine = wp.length(wp.cross(face_normal(solid, meshes, best), local))
    return best, sine


@wp.func
def off_face(solid: Solid, meshes: Meshes, face: int, point: wp.vec3) -> float:
    """How far a point of the world is from a face: off its plane, and beyond its sides."""
    at = into(solid, point)
    normal = face_normal(solid, meshes, face)
    count = corner_count(solid, meshes, face)
    centre = wp.vec3(0.0)
    for k in range(count):
        centre += face_corner(solid, meshes, face, k) / float(count)
    begin = face_corner(solid, meshes, face, count - 1)
    off = wp.abs(wp.dot(normal, at - begin))
    outside = float(0.0)
    for k in range(count):
        end = face_corner(solid, meshes, face, k)
        side = wp.normalize(wp.cross(normal, end - begin))
        inward = wp.sign(wp.dot(side, centre - begin))
        outside = wp.max(outside, -inward * wp.dot(side, at - begin))
        begin = end
    return off + outside


@wp.func
def farthest(solid: Solid, meshes: Meshes, direction: wp.vec3) -> wp.vec3:
    """The solid's point that lies farthest along a unit direction, both in the world; not for height fields."""
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
def tied_corner(solid: Solid, meshes: Meshes, direction: wp.vec3, corner: wp.vec3) -> tuple[wp.bool, wp.vec3]:
    """The corner of a box or mesh that lies as far along a direction as its farthest one does, if there is another."""
    found = bool(False)
    other = wp.vec3(0.0)
    least = float(_TIED * scale(solid))
    count = int(0)
    if solid.type == GeomType.BOX:
        count = 8
    elif solid.type == GeomType.MESH:
        count = meshes.mesh_vertnum[solid.mesh]
    for k in range(count):
        point = wp.vec3(0.0)
        if solid.type == GeomType.BOX:
            for i in range(3):
                point[i] = wp.where((k >> i) & 1 == 0, solid.size[i], -solid.size[i])
        else:
            point = meshes.mesh_vert[meshes.mesh_vertadr[solid.mesh] + k]
        point = out_of(solid, point)
        below = wp.dot(direction, corner - point)
        if below < least and wp.length(point - corner) > _TIED * scale(solid):
            found = bool(True)
            least = below
            other = point
    return found, other


@wp.func
def scale(solid: Solid) -> float:
    """A length of the order of the solid's size."""
    return wp.max(solid.size)
