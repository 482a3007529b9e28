"""Which point of a geom stands above a face of another one in a contact, and how it moves.

MuJoCo's convex collision finds one such point, or clips an edge or a face of the geom against the face's sides and
returns what is left: corners of its own, edges cut by a side, and points over the face's corners. A contact tells by
where it lies which of them it is. Candidates are tried from the simplest on, and a later one has to be nearer by more
than rounding, so that a corner that happens to lie on a side stays a corner.
"""

import warp as wp
from mujoco_warp import GeomType

from msk_ray.step.adjoint.groups import Meshes
from msk_ray.step.adjoint.laws.contact_geometry.contact_point import ContactPoint
from msk_ray.step.adjoint.laws.contact_geometry.convex_laws import Foot
from msk_ray.step.adjoint.laws.contact_geometry.patches import ellipsoid_bend, rim_bend, tangential
from msk_ray.step.adjoint.laws.contact_geometry.side_lines import side_offset
from msk_ray.step.adjoint.laws.contact_geometry.solids import (
    Solid,
    corner_count,
    face_corner,
    face_count,
    face_normal,
    farthest,
    out_of,
    scale,
)
from msk_ray.step.adjoint.spatial import column

wp.set_module_options({"enable_backward": False})

_ROUNDING = wp.constant(2.0e-5)
"""How much nearer, in sizes, a less simple candidate must come."""
_PARALLEL = wp.constant(1.0e-4)
"""Sine of an angle below which two directions do not cross."""
_NEAR = wp.constant(1.0e-2)
"""Distance, in sizes, beyond which an edge or a side plane has nothing to do with a contact."""
_BY_OTHERS = wp.constant(2.0e-4)
"""How far a capsule's side line may be from the one that the face's normal gives, in radii."""
_UPRIGHT = wp.constant(2.5e-4)
"""Tilt of a cylinder below which its rim points are fixed to it: there float32 cannot tell which one is lowest."""


@wp.struct
class Ground:
    """The face that gives a contact its normal."""

    solid: Solid
    face: wp.int32
    normal: wp.vec3
    """Outward, in the world."""
    origin: wp.vec3
    """A point of it."""
    length: wp.float32
    """Unit of length, of the order of both geoms' sizes."""


@wp.func
def miss_of(place: wp.vec3, ground: Ground, contact: ContactPoint) -> float:
    """How far the contact that a candidate would give is from the actual one [m]."""
    foot = contact.point - 0.5 * contact.dist * contact.normal
    height = wp.dot(ground.normal, place - ground.origin)
    aside = tangential(ground.normal) @ (place - foot)
    return wp.length(aside) + wp.abs(height * wp.dot(ground.normal, contact.normal) - contact.dist)


@wp.func
def fixed_foot(place: wp.vec3, bend: wp.mat33) -> Foot:
    """A point that moves with its geom, and around it as its bend says."""
    foot = Foot()
    foot.place = place
    foot.bend = bend
    foot.slide = wp.identity(n=3, dtype=float)
    return foot


@wp.func
def cut_foot(
    start: wp.vec3, run: wp.vec3, bend: wp.mat33, ground: Ground, meshes: Meshes, contact: ContactPoint
) -> tuple[Foot, wp.float32]:
    """The best point of a line along `run` where a side plane of the face cuts it, and its miss."""
    best = Foot()
    least = float(1.0e30)
    at = contact.point - 0.5 * contact.dist * contact.normal
    count = corner_count(ground.solid, meshes, ground.face)
    begin = out_of(ground.solid, face_corner(ground.solid, meshes, ground.face, 0))
    for k in range(count):
        end = out_of(ground.solid, face_corner(ground.solid, meshes, ground.face, (k + 1) % count))
        side = wp.normalize(wp.cross(end - begin, ground.normal))
        slope = wp.dot(side, run)
        if wp.abs(wp.dot(side, at - begin)) < _NEAR * ground.length and wp.abs(slope) > _PARALLEL:
            foot = fixed_foot(start + run * (wp.dot(side, begin - start) / slope), bend)
            foot.slide = foot.slide - wp.outer(run, side) / slope
            miss = miss_of(foot.place, ground, contact)
            if miss < least:
                least = miss
                best = foot
        begin = end
    return best, least


@wp.func
def corner_foot(
    other: Solid, other_face: int, ground: Ground, meshes: Meshes, contact: ContactPoint
) -> tuple[Foot, wp.float32]:
    """The best point of the other geom's face above a corner of the ground, and its miss."""
    best = Foot()
    least = float(1.0e30)
    normal = other.mat @ face_normal(other, meshes, other_face)
    through = out_of(other, face_corner(other, meshes, other_face, 0))
    slope = wp.dot(normal, ground.normal)
    if wp.abs(slope) > _PARALLEL:
        for k in range(corner_count(ground.solid, meshes, ground.face)):
            corner = out_of(ground.solid, face_corner(ground.solid, meshes, ground.face, k))
            foot = fixed_foot(corner + ground.normal * (wp.dot(normal, through - corner) / slope), wp.mat33())
            foot.slide = wp.outer(ground.normal, normal) / slope
            miss = miss_of(foot.place, ground, contact)
            if miss < least:
                least = miss
                best = foot
    return best, least


@wp.func
def cornered_foot(
    other: Solid, other_face: int, ground: Ground, meshes: Meshes, contact: ContactPoint, is_clipped: bool
) -> tuple[Foot, wp.float32]:
    """The best foot of a geom with corners: of one of its faces, or with -1 of all that look at the ground."""
    best = Foot()
    least = float(1.0e30)
    rounding = _ROUNDING * ground.length
    height = contact.dist / wp.dot(ground.normal, contact.normal)
    at = contact.point - 0.5 * contact.dist * contact.normal
    above = at + height * ground.normal
    first = int(0)
    last = face_count(other, meshes)
    if other_face >= 0:
        first = other_face
        last = other_face + 1
    for step in range(wp.where(is_clipped, 2, 1)):  # corners first, then edges
        for face in range(first, last):
            normal = other.mat @ face_normal(other, meshes, face)
            begin = out_of(other, face_corner(other, meshes, face, 0))
            looks = (
                wp.dot(normal, ground.normal) < -_PARALLEL
                and wp.abs(wp.dot(normal, above - begin)) < _NEAR * ground.length
            )
            if face == other_face or (other_face < 0 and looks):
                count = corner_count(other, meshes, face)
                for k in range(count):
                    end = out_of(other, face_corner(other, meshes, face, (k + 1) % count))
                    if step == 0:
                        miss = miss_of(begin, ground, contact)
                        if miss < least - rounding:
                            least = miss
                            best = fixed_foot(begin, wp.mat33())
                    else:
                        run = wp.normalize(end - begin)
                        aside = tangential(ground.normal) @ (at - begin)
                        flat_run = tangential(ground.normal) @ run
                        gap = wp.cross(aside, flat_run)
                        if wp.length(gap) < _NEAR * ground.length * wp.length(flat_run):
                            foot, miss = cut_foot(begin, run, wp.mat33(), ground, meshes, contact)
                            if miss < least - rounding:
                                least = miss
                                best = foot
                    begin = end
    if is_clipped and other_face >= 0:
        foot, miss = corner_foot(other, other_face, ground, meshes, contact)
        if miss < least - rounding:
            least = miss
            best = foot
    return best, least


@wp.func
def long_foot(
    other: Solid, ground: Ground, meshes: Meshes, contact: ContactPoint, is_clipped: bool
) -> tuple[Foot, wp.float32]:
    """The best foot of a capsule or of a cylinder's rims and side."""
    best = Foot()
    least = float(1.0e30)
    rounding = _ROUNDING * ground.length
    axis = column(other.mat, 2)
    radius = other.size[0]
    down = -ground.normal
    across = down - axis * wp.dot(axis, down)
    # Of a line along the side: of a capsule it goes through the foot of its end's lowest point.
    side = radius * across
    bend = radius * tangential(axis)
    if other.type == GeomType.CYLINDER:
        side = radius * wp.normalize(across)
        bend = wp.mat33()
        if wp.length(across) > _UPRIGHT:
            bend = rim_bend(radius, axis, down)
    line = int(0)
    if other.type == GeomType.CAPSULE and is_clipped:
        height = contact.dist / wp.dot(ground.normal, contact.normal)
        offset = side_offset(other, contact.point - 0.5 * contact.dist * contact.normal + height * ground.normal)
        if wp.length(offset - across) > _BY_OTHERS:
            line = 1
            side = radius * offset
            bend = wp.mat33()
    for end in range(2):
        centre = other.pos + axis * wp.where(end == 0, other.size[1], -other.size[1])
        if other.type == GeomType.CAPSULE:
            foot = fixed_foot(centre + radius * down, radius * tangential(down))
            miss = miss_of(foot.place, ground, contact)
            if miss < least - rounding:
                least = miss
                best = foot
        if other.type == GeomType.CYLINDER or is_clipped:
            foot = fixed_foot(centre + side, bend)
            foot.line = line
            miss = miss_of(foot.place, ground, contact)
            if miss < least - rounding:
                least = miss
                best = foot
    if is_clipped:
        foot, miss = cut_foot(other.pos + side, axis, bend, ground, meshes, contact)
        foot.line = line
        if miss < least - rounding:
            least = miss
            best = foot
    return best, least


@wp.func
def foot_of(
    other: Solid, other_face: int, ground: Ground, meshes: Meshes, contact: ContactPoint, is_clipped: bool
) -> tuple[Foot, wp.float32]:
    """The foot of a geom on the ground that makes the contact, and how far it misses it [m].

    A sphere and an ellipsoid have but one point that can be it.

    Args:
        other: the geom.
        other_face: its face that is clipped, -1 for none.
        ground: the face below it.
        meshes: hulls of meshes.
        contact: its normal points away from the ground.
        is_clipped: whether the collision clips against the ground's sides.
    """
    foot = Foot()
    miss = float(0.0)
    down = -ground.normal
    if other.type == GeomType.SPHERE:
        foot = fixed_foot(farthest(other, meshes, down), other.size[0] * tangential(down))
    elif other.type == GeomType.ELLIPSOID:
        foot = fixed_foot(farthest(other, meshes, down), ellipsoid_bend(other.mat, other.size, down))
    elif other.type == GeomType.CAPSULE or (other.type == GeomType.CYLINDER and other_face < 0):
        foot, miss = long_foot(other, ground, meshes, contact, is_clipped)
    else:
        foot, miss = cornered_foot(other, other_face, ground, meshes, contact, is_clipped)
    return foot, miss


@wp.func
def ground_of(solid: Solid, meshes: Meshes, face: int, length: float) -> Ground:
    """A face as the ground of a contact."""
    ground = Ground()
    ground.solid = solid
    ground.face = face
    ground.normal = solid.mat @ face_normal(solid, meshes, face)
    # A mesh's faces are flat up to rounding only: MuJoCo's clipping takes the plane through the last corner.
    ground.origin = out_of(solid, face_corner(solid, meshes, face, corner_count(solid, meshes, face) - 1))
    ground.length = length
    return ground


@wp.func
def unit_of_length(solid1: Solid, solid2: Solid) -> float:
    """A length of the order of two geoms' sizes."""
    return 0.5 * (scale(solid1) + scale(solid2))
