"""The surface of a convex geom around the point where another one touches it, to second order.

A contact of two convex geoms depends on each of them only through such a patch. Turn the normal n of a patch by δn in
the geom's own coordinates, and its point moves along the surface by ρ δn: ρ is the radius of curvature, by direction in
the tangent plane. It is 0 at a corner, 0 across an edge, infinite along an edge and everywhere on a face.
"""

import warp as wp
from mujoco_warp import GeomType

from msk_ray.step.adjoint.groups import Meshes
from msk_ray.step.adjoint.laws.contact_geometry.solids import (
    Solid,
    corner_count,
    face_corner,
    face_count,
    face_normal,
    has_corners,
    into,
    scale,
)
from msk_ray.step.adjoint.spatial import column

wp.set_module_options({"enable_backward": False})

POINT, EDGE, FACE = wp.constant(0), wp.constant(1), wp.constant(2)
"""Directions in which the radius of curvature is infinite: none, one, both."""

_NEAR = wp.constant(5.0e-4)
"""Distance from a rim, in sizes, below which a contact is at it."""
_ROUNDING = wp.constant(2.0e-7)
"""Rounding of a place in float32, in sizes of the numbers it is computed from."""
_SAME = wp.constant(3.0e-6)
"""Sine of an angle between equal normals, from rounding."""
_BESIDE_CORE = wp.constant(1.0e-4)
"""How far from its radius off its core, in radii, the surface of a sphere or a capsule may be."""
_FLAT = wp.constant(5.0e-2)
"""Sine of the angle from a face's normal beyond which a contact away from its edges is still not the face's."""
_BESIDE = wp.constant(2.0e-2)
"""Distance from a face's plane, in sizes, above which its corners and edges are not looked at."""
_RIM = wp.constant(1.0e-3)
"""The same for the rim seen from the cap, between whose corners the contact point may lie."""


@wp.struct
class Patch:
    """The surface around one contact point; vectors are the world's."""

    kind: wp.int32
    face: wp.int32
    """FACE: which one."""
    run: wp.vec3
    """EDGE: its direction."""
    bend: wp.mat33
    """Finite radii of curvature [m], a map of the tangent plane to itself."""


@wp.func
def tangential(normal: wp.vec3) -> wp.mat33:
    """The projector onto the plane across a unit vector."""
    return wp.identity(n=3, dtype=float) - wp.outer(normal, normal)


@wp.func
def rim_bend(radius: float, axis: wp.vec3, normal: wp.vec3) -> wp.mat33:
    """Radii of curvature of a rim, or of a cylinder's side, where the outward normal is `normal`."""
    across = normal - axis * wp.dot(axis, normal)
    aside = wp.cross(axis, wp.normalize(across))
    return (radius / wp.length(across)) * wp.outer(aside, aside)


@wp.func
def ellipsoid_bend(mat: wp.mat33, size: wp.vec3, normal: wp.vec3) -> wp.mat33:
    """Radii of curvature of an ellipsoid: the Hessian of its support function h = ‖S m‖, S = diag(size)."""
    m = wp.transpose(mat) @ normal
    squares = wp.cw_mul(size, size)
    support = wp.length(wp.cw_mul(size, m))
    to_point = wp.cw_mul(squares, m) / support
    hessian = (wp.diag(squares) - wp.outer(to_point, to_point)) / support
    return mat @ hessian @ wp.transpose(mat)


@wp.func
def nearest_feature(
    solid: Solid, meshes: Meshes, point: wp.vec3, outward: wp.vec3
) -> tuple[wp.float32, wp.float32, wp.vec3]:
    """Distances of a local point from the nearest corner and edge of faces that look along `outward`; that edge's way.

    Both are huge if no face is near.
    """
    to_corner = float(1.0e30)
    to_edge = float(1.0e30)
    run = wp.vec3(0.0)
    for face in range(face_count(solid, meshes)):
        normal = face_normal(solid, meshes, face)
        begin = face_corner(solid, meshes, face, 0)
        if wp.dot(normal, outward) > -_RIM and wp.abs(wp.dot(normal, point - begin)) < _BESIDE * scale(solid):
            count = corner_count(solid, meshes, face)
            for k in range(count):
                end = face_corner(solid, meshes, face, (k + 1) % count)
                way = end - begin
                t = wp.clamp(wp.dot(point - begin, way) / wp.dot(way, way), 0.0, 1.0)
                to_corner = wp.min(to_corner, wp.length(point - begin))
                gap = wp.length(point - begin - t * way)
                if gap < to_edge:
                    to_edge = gap
                    run = way
                begin = end
    return to_corner, to_edge, run


@wp.func
def rounding_of(solid: Solid, other: Solid) -> float:
    """Rounding of places on two geoms in float32 [m]."""
    return _ROUNDING * (scale(solid) + scale(other) + wp.length(solid.pos - other.pos) + wp.length(solid.pos))


@wp.func
def core_place(solid: Solid, point: wp.vec3) -> wp.vec3:
    """The point of a sphere's centre or a capsule's axis that is nearest a point of the world."""
    axis = column(solid.mat, 2)
    half = wp.where(solid.type == GeomType.CAPSULE, solid.size[1], 0.0)
    return solid.pos + axis * wp.clamp(wp.dot(axis, point - solid.pos), -half, half)


@wp.func
def core_reach(other: Solid, dist: float) -> float:
    """Distance of a contact's witness point from the other geom's core: the normal is the direction between them."""
    rounded = other.type == GeomType.SPHERE or other.type == GeomType.CAPSULE
    return wp.abs(dist + wp.where(rounded, other.size[0], 0.0))


@wp.func
def misses_face(other: Solid, plane: wp.vec3, point: wp.vec3, outward: wp.vec3, dist: float) -> float:
    """How far a contact is from one with a face of its normal, beyond what it is from one of its own normal [m].

    Witness points lie on one normal. A sphere or a capsule touches with a point that is its radius off its core, along
    the normal. Where MuJoCo clips a capsule's side, that need not hold for either normal.

    Args:
        other: the other geom.
        plane: outward normal of the face.
        point: where the contact is on the geom of the face.
        outward: normal of the contact.
        dist: distance.
    """
    miss = wp.abs(dist) * wp.length(plane - outward)
    if other.type == GeomType.SPHERE or other.type == GeomType.CAPSULE:
        place = point + dist * outward
        own = wp.length(place + other.size[0] * outward - core_place(other, place + other.size[0] * outward))
        of_face = wp.length(place + other.size[0] * plane - core_place(other, place + other.size[0] * plane))
        miss = wp.where(own < of_face and own < _BESIDE_CORE * other.size[0], of_face, 0.0)
    return miss


@wp.func
def patch_at(
    solid: Solid,
    other: Solid,
    meshes: Meshes,
    point: wp.vec3,
    outward: wp.vec3,
    dist: float,
    face: int,
    sine: float,
    slack: float,
) -> Patch:
    """The patch of a solid around a point of the world where its outward normal is `outward`.

    On a face the normal is the face's, and the point anywhere within it; on an edge the point is on the edge, and the
    normal anywhere between those of its faces; at a corner both are looser and stricter by one more step. So the point
    and the normal tell how far, in lengths, the contact is from one of each kind, and the nearer kind is taken. No
    angle can tell, because there are edges of any angle.

    Args:
        other: the geom that it touches.
        dist: distance of the contact.
        face: the one whose normal is nearest `outward`, -1 for none.
        sine: of the angle between that normal and `outward`.
        slack: below this angle a face has been clipped, or the normal is the face's up to rounding.
    """
    patch = Patch()
    patch.face = -1
    size = solid.size
    axis = column(solid.mat, 2)
    local = into(solid, point)
    rounding = rounding_of(solid, other)
    if solid.type == GeomType.SPHERE:
        patch.bend = size[0] * tangential(outward)
    elif solid.type == GeomType.ELLIPSOID:
        patch.bend = ellipsoid_bend(solid.mat, size, outward)
    elif solid.type == GeomType.CAPSULE:
        patch.bend = size[0] * tangential(outward)
        to_end = size[1] - wp.abs(wp.dot(point - size[0] * outward - solid.pos, axis))
        if to_end > wp.max(size[0] * wp.abs(wp.dot(outward, axis)), rounding):
            patch.kind = EDGE
            patch.run = axis
    elif solid.type == GeomType.CYLINDER:
        from_axis = wp.length(wp.vec2(local[0], local[1]))
        on_cap = wp.abs(local[2]) > (1.0 - _RIM) * size[1]
        if face >= 0 and (sine < slack or (on_cap and from_axis < (1.0 - _RIM) * size[0])):
            patch.kind = FACE
            patch.face = face
        else:
            patch.bend = rim_bend(size[0], axis, outward)
            if wp.abs(local[2]) < (1.0 - _NEAR) * size[1]:
                patch.kind = EDGE
                patch.run = axis
    elif has_corners(solid):
        if face >= 0 and sine < _SAME:
            patch.kind = FACE
            patch.face = face
        else:
            to_corner, to_edge, run = nearest_feature(solid, meshes, local, wp.transpose(solid.mat) @ outward)
            run = wp.normalize(solid.mat @ run)
            off_face = float(1.0e30)
            if face >= 0:
                off_face = misses_face(other, solid.mat @ face_normal(solid, meshes, face), point, outward, dist)
            if sine < slack or (sine < _FLAT and off_face <= wp.max(to_edge, rounding)):
                patch.kind = FACE
                patch.face = face
            elif to_corner > wp.max(wp.abs(wp.dot(run, outward)) * core_reach(other, dist), rounding):
                patch.kind = EDGE
                patch.run = run
    return patch
