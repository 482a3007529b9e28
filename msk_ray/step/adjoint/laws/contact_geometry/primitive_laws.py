"""How a contact of spheres, capsules, cylinders and boxes moves with both bodies, also at symmetric poses.

MuJoCo Warp's own collision functions, except where a square root, an absolute value or a clamp of theirs has no slope
although the contact has one: a sphere's centre on a cylinder's axis or on a box's face, and parallel capsules whose
ends lie side by side.
"""

import warp as wp
from mujoco_warp import GeomType

from msk_ray.step.adjoint.laws.contact_geometry.contact_point import Bars, Geom
from msk_ray.step.adjoint.spatial import column
from msk_ray.step.forward.mjw_private import (
    capsule_capsule,
    plane_ellipsoid,
    plane_sphere,
    sphere_box,
    sphere_capsule,
    sphere_sphere,
)

wp.set_module_options({"enable_backward": False})

CROSSED, END1, END2, BOTH_ENDS, SIDE_BY_SIDE = (wp.constant(i) for i in range(5))
"""Capsules: not parallel; parallel, with the contact at an end of the first, of the second, of both where one capsule
ends as the other begins, or of both where they end side by side."""

_PARALLEL = wp.constant(1.0e-8)
"""Squared sine below which MuJoCo Warp takes two capsules as parallel."""
_SAME_END = wp.constant(1.0e-5)
"""Share of a capsule's length within which two ends lie side by side: float32 cannot tell which one is inside."""
_COINCIDENT = wp.constant(2.0e-6)
"""Distance, as a share of the size of the numbers it is computed from, that is their rounding in float32."""
_LEAST_TILT = wp.constant(5.0e-6)
"""Sine of a cylinder's tilt below which its rim points are taken as fixed to it.

The lowest point runs around the rim at 1/tilt, and float32 knows the angle between two directions up to 1e-7.
"""


@wp.struct
class ParallelLaw:
    """Places of a contact's two spheres on the axes of parallel capsules."""

    kind: wp.int32
    end1: wp.float32
    """Place of the first capsule's end, in length from its centre."""
    end2: wp.float32


@wp.func
def parallel_law(
    index: int, pos1: wp.vec3, axis1: wp.vec3, half1: float, pos2: wp.vec3, axis2: wp.vec3, half2: float
) -> ParallelLaw:
    """The law of contact `index` of two capsules, as MuJoCo Warp picks the closest points of their axes."""
    law = ParallelLaw()
    cross = wp.cross(axis1, axis2)
    if wp.dot(cross, cross) > _PARALLEL or half1 == 0.0 or half2 == 0.0:
        return law
    law.end1 = wp.where(index == 0, -half1, half1)
    # Place of that end along the second capsule, in half lengths.
    place2 = wp.dot(axis2, pos1 + law.end1 * axis1 - pos2) / half2
    law.end2 = wp.where(place2 < 0.0, -half2, half2)
    # Place of the second's nearer end along the first.
    place1 = wp.dot(axis1, pos2 + law.end2 * axis2 - pos1) / half1
    law.kind = END1
    if wp.abs(wp.abs(place2) - 1.0) < _SAME_END:
        law.kind = SIDE_BY_SIDE
        if law.end1 * law.end2 * wp.dot(axis1, axis2) < 0.0:
            law.kind = BOTH_ENDS
    elif wp.abs(place2) > 1.0:
        law.kind = END2
        if wp.abs(place1) > 1.0 - _SAME_END:
            law.end1 = wp.where(place1 < 0.0, -half1, half1)
            law.kind = BOTH_ENDS
    return law


@wp.func
def cores_coincide(
    type1: int, type2: int, pos1: wp.vec3, size1: wp.vec3, pos2: wp.vec3, size2: wp.vec3, dist: float
) -> bool:
    """Whether the nearest points of the axes or centres of two spheres or capsules are one point, up to rounding.

    Links drawn as capsules from joint to joint share it, and collide where the first one belongs to the world. The
    normal is then that of rounding, and its slope, which grows as one over the distance, that of nothing.
    """
    if type1 != GeomType.SPHERE and type1 != GeomType.CAPSULE:
        return False
    if type2 != GeomType.SPHERE and type2 != GeomType.CAPSULE:
        return False
    extent = wp.max(wp.length(pos1), wp.length(pos2)) + size1[0] + size1[1] + size2[0] + size2[1]
    return wp.abs(dist + size1[0] + size2[0]) < _COINCIDENT * extent


@wp.func
def parallel_contact(
    pos1: wp.vec3,
    axis1: wp.vec3,
    radius1: float,
    pos2: wp.vec3,
    axis2: wp.vec3,
    radius2: float,
    law: ParallelLaw,
    kind: int,
) -> tuple[wp.float32, wp.vec3, wp.vec3]:
    """Contact of two parallel capsules where the sphere at one end meets its foot on the other, or another end."""
    point1 = pos1 + law.end1 * axis1
    point2 = pos2 + law.end2 * axis2
    if kind == END1:
        point2 = pos2 + wp.dot(axis2, point1 - pos2) * axis2
    if kind == END2:
        point1 = pos1 + wp.dot(axis1, point2 - pos1) * axis1
    dist, pos, normal = sphere_sphere(point1, radius1, point2, radius2)
    return dist, pos, normal


@wp.func
def sphere_cylinder_contact(
    pos: wp.vec3, radius: float, cylinder_pos: wp.vec3, axis: wp.vec3, cylinder_radius: float, half: float
) -> tuple[wp.float32, wp.vec3, wp.vec3]:
    """Contact of a sphere with a cylinder's side, cap or rim, whichever is nearest."""
    offset = pos - cylinder_pos
    x = wp.dot(offset, axis)
    across = offset - x * axis
    square = wp.dot(across, across)
    beside = wp.abs(x) < half
    below_cap = square < cylinder_radius * cylinder_radius
    if beside and below_cap:
        # Inside: the cap is nearer where half - |x| < R - |across|.
        gap = cylinder_radius - (half - wp.abs(x))
        if gap > 0.0 and square < gap * gap:
            beside = False
        else:
            below_cap = False
    up = wp.where(x > 0.0, 1.0, -1.0)
    if beside:
        dist, point, normal = sphere_sphere(pos, radius, cylinder_pos + x * axis, cylinder_radius)
    elif below_cap:
        dist, point = plane_sphere(up * axis, cylinder_pos + (up * half) * axis, pos, radius)
        normal = -up * axis
    else:
        rim = cylinder_pos + (up * half) * axis + across * (cylinder_radius / wp.sqrt(square))
        dist, point, normal = sphere_sphere(pos, radius, rim, 0.0)
    return dist, point, normal


@wp.func
def sphere_box_contact(
    pos: wp.vec3, radius: float, box_pos: wp.vec3, box_mat: wp.mat33, size: wp.vec3
) -> tuple[wp.float32, wp.vec3, wp.vec3]:
    """Contact of a sphere with a box; from inside with the nearest face, whose distance is signed."""
    centre = wp.transpose(box_mat) @ (pos - box_pos)
    inside = wp.abs(centre[0]) <= size[0] and wp.abs(centre[1]) <= size[1] and wp.abs(centre[2]) <= size[2]
    if inside:
        k = wp.int32(0)
        for i in range(3):
            if size[i] - wp.abs(centre[i]) < size[k] - wp.abs(centre[k]):
                k = i
        out = wp.vec3(0.0)
        out[k] = wp.where(centre[k] > 0.0, 1.0, -1.0)
        height = wp.dot(out, centre) - wp.dot(wp.cw_mul(out, out), size)
        dist = height - radius
        normal = -(box_mat @ out)
        point = pos + normal * (0.5 * (radius + height))
    else:
        dist, point, normal = sphere_box(pos, radius, box_pos, box_mat, size)
    return dist, point, normal


@wp.func
def rim_torque(normal: wp.vec3, axis: wp.vec3, arm: wp.vec3, core_bar: wp.vec3) -> tuple[wp.vec3, wp.bool]:
    """Torque on a cylinder, and its opposite on the plane, that turns the lowest point of the rim around; whether it is
    exact.

    Args:
        normal: of the plane.
        axis: of the cylinder.
        arm: of the contact's point on the rim from the cylinder's centre.
        core_bar: cotangent of that point.
    """
    aside = wp.cross(normal, axis)
    tilt = wp.length(aside)
    if tilt < _LEAST_TILT:
        return wp.vec3(0.0), False
    # The rim points turn about the axis by ψ = ω·(n × s) / sin(tilt), s = n × axis / sin(tilt): dp = ψ axis × arm
    return wp.cross(normal, aside / tilt) * (wp.dot(core_bar, wp.cross(axis, arm)) / tilt), True


@wp.func
def pair_potential(geom1: Geom, geom2: Geom, law: ParallelLaw, weights: Bars) -> wp.float32:
    """Weighted sum of (dist, pos, normal) of a contact of a pair; `law` counts for two capsules only."""
    type1 = geom1.type
    type2 = geom2.type
    pos1 = geom1.pos
    pos2 = geom2.pos
    size1 = geom1.size
    size2 = geom2.size
    mat2 = geom2.mat
    axis1 = column(geom1.mat, 2)
    axis2 = column(geom2.mat, 2)
    dist = wp.float32(0.0)
    pos = wp.vec3(0.0)
    normal = wp.vec3(0.0)
    if type1 == GeomType.SPHERE and type2 == GeomType.SPHERE:
        dist, pos, normal = sphere_sphere(pos1, size1[0], pos2, size2[0])
    elif type1 == GeomType.SPHERE and type2 == GeomType.CAPSULE:
        dist, pos, normal = sphere_capsule(pos1, size1[0], pos2, axis2, size2[0], size2[1])
    elif type1 == GeomType.SPHERE and type2 == GeomType.CYLINDER:
        dist, pos, normal = sphere_cylinder_contact(pos1, size1[0], pos2, axis2, size2[0], size2[1])
    elif type1 == GeomType.SPHERE and type2 == GeomType.BOX:
        dist, pos, normal = sphere_box_contact(pos1, size1[0], pos2, mat2, size2)
    elif type1 == GeomType.CAPSULE and type2 == GeomType.CAPSULE:
        if law.kind == CROSSED:
            dists, places, normals = capsule_capsule(pos1, axis1, size1[0], size1[1], pos2, axis2, size2[0], size2[1])
            dist = dists[0]
            pos = places[0]
            normal = normals[0]
        elif law.kind == SIDE_BY_SIDE:
            # Whichever end comes to lie inside leads the contact: a pair of such contacts does the mean of both.
            dist_a, pos_a, normal_a = parallel_contact(pos1, axis1, size1[0], pos2, axis2, size2[0], law, END1)
            dist_b, pos_b, normal_b = parallel_contact(pos1, axis1, size1[0], pos2, axis2, size2[0], law, END2)
            dist = 0.5 * (dist_a + dist_b)
            pos = 0.5 * (pos_a + pos_b)
            normal = 0.5 * (normal_a + normal_b)
        else:
            dist, pos, normal = parallel_contact(pos1, axis1, size1[0], pos2, axis2, size2[0], law, law.kind)
    elif type1 == GeomType.PLANE and type2 == GeomType.ELLIPSOID:
        dist, pos, normal = plane_ellipsoid(axis1, pos1, pos2, mat2, size2)
    return weights.dist * dist + wp.dot(weights.point, pos) + wp.dot(weights.normal, normal)


@wp.func
def has_potential(type1: int, type2: int) -> bool:
    """Whether `pair_potential` knows the pair."""
    if type1 == GeomType.SPHERE:
        return (
            type2 == GeomType.SPHERE or type2 == GeomType.CAPSULE or type2 == GeomType.CYLINDER or type2 == GeomType.BOX
        )
    if type1 == GeomType.CAPSULE:
        return type2 == GeomType.CAPSULE
    return type1 == GeomType.PLANE and type2 == GeomType.ELLIPSOID


@wp.func
def is_convex_pair(type1: int, type2: int) -> bool:
    """Whether two geoms, types in ascending order, collide by MuJoCo's convex collision, or are boxes."""
    apart = type1 == GeomType.PLANE or has_potential(type1, type2)
    return not (apart or (type1 == GeomType.CAPSULE and type2 == GeomType.BOX))


POTENTIAL_PAIRS = frozenset(
    {
        *((int(GeomType.SPHERE), int(t)) for t in (GeomType.SPHERE, GeomType.CAPSULE, GeomType.CYLINDER, GeomType.BOX)),
        (int(GeomType.CAPSULE), int(GeomType.CAPSULE)),
        (int(GeomType.PLANE), int(GeomType.ELLIPSOID)),
    }
)
"""Geometry types, ascending, that `pair_potential` knows."""

_SOLIDS = [
    *(GeomType.SPHERE, GeomType.CAPSULE, GeomType.ELLIPSOID, GeomType.CYLINDER, GeomType.BOX, GeomType.MESH),
]
CONVEX_PAIRS = frozenset(
    {(int(a), int(b)) for a in (GeomType.HFIELD, *_SOLIDS) for b in _SOLIDS if a <= b}
    - POTENTIAL_PAIRS
    - {(int(GeomType.CAPSULE), int(GeomType.BOX))}
)
"""Those for which `is_convex_pair` holds."""

STANDING_PAIRS = frozenset({(int(GeomType.PLANE), int(GeomType.CYLINDER))})
"""Those in which a point runs around a rim, the faster the less it is tilted."""
