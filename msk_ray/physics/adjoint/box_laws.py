"""How a contact of a box with a box or a capsule moves with both bodies: one smooth law a feature pair.

Box collision is a search for features (corner, edge, face) followed by plain geometry of those found. A contact tells
by where it lies which features these were: the law that reproduces its point and normal is the one that made it, and
only that law is differentiated. Local axes (e, f) are signed unit vectors of a box's frame, q points in it.
"""

import warp as wp

from msk_ray.physics.adjoint.pair_laws import sphere_box_contact

wp.set_module_options({"enable_backward": False})

CORNER, CROSSING, FACE_POINT = wp.constant(0), wp.constant(1), wp.constant(2)
"""Vertices of a clipped face: own corner, edge cut by a side plane of the other, point over the other's corner."""

END, EDGE, SPHERE_CORNER, SIDE = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)
"""Places on a capsule's axis: an end, next to a box's edge, next to its corner, over a side plane."""


@wp.struct
class FaceLaw:
    """Contact on a face of the reference box, with a vertex of the other box's face clipped against it."""

    normal_ref: wp.vec3
    """Outward normal of the reference face, local."""
    offset_ref: wp.float32
    normal_inc: wp.vec3
    """Outward normal of the clipped face, local."""
    offset_inc: wp.float32
    vertex: wp.int32
    q_inc: wp.vec3
    run: wp.vec3
    """CROSSING: direction of the edge that is cut, local to the clipped box."""
    side: wp.vec3
    """CROSSING: normal of the side plane, local to the reference box."""
    cut: wp.float32
    q_ref: wp.vec3
    along_inc: wp.int32
    """1: the normal belongs to the clipped face, as where two faces lie on each other."""


@wp.struct
class EdgeLaw:
    """Contact of two edges."""

    edge1: wp.vec3
    edge2: wp.vec3
    q1: wp.vec3
    q2: wp.vec3
    sign: wp.float32


@wp.struct
class PointLaw:
    """Contact of two corners (both runs zero), or of a corner and an edge, apart from each other."""

    q1: wp.vec3
    q2: wp.vec3
    run1: wp.vec3
    run2: wp.vec3


@wp.struct
class AxisLaw:
    """Place of a contact's sphere on a capsule's axis, in length from its centre."""

    place: wp.int32
    end: wp.float32
    q: wp.vec3
    run: wp.vec3
    side: wp.vec3
    cut: wp.float32
    shift_axis: wp.vec3
    """Local axis whose slope sets the distance of the second sphere from the first; zero: it is the first."""
    shift: wp.float32
    """Width in length that the way to the second sphere crosses, signed along the capsule."""
    shift_along_edge: wp.float32
    """Part of the way that depends on the place along the edge: ±1, or zero."""


@wp.func
def face_contact(
    pos_ref: wp.vec3, mat_ref: wp.mat33, pos_inc: wp.vec3, mat_inc: wp.mat33, law: FaceLaw
) -> tuple[wp.float32, wp.vec3, wp.vec3]:
    """Distance, point and normal (away from the reference box) of a vertex over a face."""
    normal_ref = mat_ref @ law.normal_ref
    normal_inc = mat_inc @ law.normal_inc
    vertex = pos_inc + mat_inc @ law.q_inc
    if law.vertex == CROSSING:
        run = mat_inc @ law.run
        side = mat_ref @ law.side
        vertex = vertex + run * ((law.cut - wp.dot(side, vertex - pos_ref)) / wp.dot(side, run))
    if law.vertex == FACE_POINT:
        below = pos_ref + mat_ref @ law.q_ref
        rise = (law.offset_inc - wp.dot(normal_inc, below - pos_inc)) / wp.dot(normal_inc, normal_ref)
        vertex = below + rise * normal_ref
    height = wp.dot(vertex - pos_ref, normal_ref) - law.offset_ref
    foot = vertex - height * normal_ref
    normal = wp.where(law.along_inc == 1, -normal_inc, normal_ref)
    depth = wp.dot(vertex - foot, normal)
    return depth, foot + 0.5 * depth * normal, normal


@wp.func
def edge_contact(
    pos1: wp.vec3, mat1: wp.mat33, pos2: wp.vec3, mat2: wp.mat33, law: EdgeLaw
) -> tuple[wp.float32, wp.vec3, wp.vec3]:
    """Distance along the common normal of two edges, middle of their closest points, and that normal."""
    d1 = mat1 @ law.edge1
    d2 = mat2 @ law.edge2
    x1 = pos1 + mat1 @ law.q1
    x2 = pos2 + mat2 @ law.q2
    normal = law.sign * wp.normalize(wp.cross(d1, d2))
    gap = x2 - x1
    # Closest points x1 + s d1 and x2 + t d2:  s - b t = d1·gap ,  b s - t = d2·gap ,  b = d1·d2
    b = wp.dot(d1, d2)
    s = (wp.dot(d1, gap) - b * wp.dot(d2, gap)) / (1.0 - b * b)
    t = (b * wp.dot(d1, gap) - wp.dot(d2, gap)) / (1.0 - b * b)
    return wp.dot(gap, normal), 0.5 * (x1 + s * d1 + x2 + t * d2), normal


@wp.func
def point_contact(
    pos1: wp.vec3, mat1: wp.mat33, pos2: wp.vec3, mat2: wp.mat33, law: PointLaw
) -> tuple[wp.float32, wp.vec3, wp.vec3]:
    """Distance of a corner from a corner or an edge, their middle, and the direction between them."""
    d1 = mat1 @ law.run1
    d2 = mat2 @ law.run2
    x1 = pos1 + mat1 @ law.q1
    x2 = pos2 + mat2 @ law.q2
    gap = x2 - x1
    # One of the two runs is zero at least, so each slides on its own.
    y1 = x1 + wp.dot(d1, gap) * d1
    y2 = x2 - wp.dot(d2, gap) * d2
    dist = wp.length(y2 - y1)
    return dist, 0.5 * (y1 + y2), (y2 - y1) / dist


@wp.func
def axis_place(pos: wp.vec3, axis: wp.vec3, box_pos: wp.vec3, box_mat: wp.mat33, law: AxisLaw) -> wp.float32:
    """Place of the contact's sphere on the capsule's axis, in length from its centre."""
    place = law.end
    along = wp.float32(0.0)
    if law.place == SPHERE_CORNER:
        place = wp.dot(axis, box_pos + box_mat @ law.q - pos)
    if law.place == EDGE:
        run = box_mat @ law.run
        gap = box_pos + box_mat @ law.q - pos
        b = wp.dot(axis, run)
        place = (wp.dot(axis, gap) - b * wp.dot(run, gap)) / (1.0 - b * b)
        along = (b * wp.dot(axis, gap) - wp.dot(run, gap)) / (1.0 - b * b)
    if law.place == SIDE:
        side = box_mat @ law.side
        place = (law.cut - wp.dot(side, pos - box_pos)) / wp.dot(side, axis)
    if law.shift != 0.0:
        slope = wp.abs(wp.dot(box_mat @ law.shift_axis, axis))
        place = place + (law.shift + law.shift_along_edge * along) / slope
    return place


@wp.func
def capsule_contact(
    pos: wp.vec3, axis: wp.vec3, radius: float, box_pos: wp.vec3, box_mat: wp.mat33, box_size: wp.vec3, law: AxisLaw
) -> tuple[wp.float32, wp.vec3, wp.vec3]:
    """Contact of the capsule's sphere at the law's place with the box."""
    centre = pos + axis * axis_place(pos, axis, box_pos, box_mat, law)
    dist, point, normal = sphere_box_contact(centre, radius, box_pos, box_mat, box_size)
    return dist, point, normal


@wp.func
def face_score(
    pos_ref: wp.vec3,
    mat_ref: wp.mat33,
    pos_inc: wp.vec3,
    mat_inc: wp.mat33,
    law: FaceLaw,
    dist_weight: float,
    pos_weight: wp.vec3,
    normal_weight: wp.vec3,
) -> wp.float32:
    """Weighted sum of what `face_contact` returns."""
    dist, point, normal = face_contact(pos_ref, mat_ref, pos_inc, mat_inc, law)
    return dist_weight * dist + wp.dot(pos_weight, point) + wp.dot(normal_weight, normal)


@wp.func
def edge_score(
    pos1: wp.vec3,
    mat1: wp.mat33,
    pos2: wp.vec3,
    mat2: wp.mat33,
    law: EdgeLaw,
    dist_weight: float,
    pos_weight: wp.vec3,
    normal_weight: wp.vec3,
) -> wp.float32:
    """Weighted sum of what `edge_contact` returns."""
    dist, point, normal = edge_contact(pos1, mat1, pos2, mat2, law)
    return dist_weight * dist + wp.dot(pos_weight, point) + wp.dot(normal_weight, normal)


@wp.func
def point_score(
    pos1: wp.vec3,
    mat1: wp.mat33,
    pos2: wp.vec3,
    mat2: wp.mat33,
    law: PointLaw,
    dist_weight: float,
    pos_weight: wp.vec3,
    normal_weight: wp.vec3,
) -> wp.float32:
    """Weighted sum of what `point_contact` returns."""
    dist, point, normal = point_contact(pos1, mat1, pos2, mat2, law)
    return dist_weight * dist + wp.dot(pos_weight, point) + wp.dot(normal_weight, normal)


@wp.func
def capsule_score(
    pos: wp.vec3,
    axis: wp.vec3,
    radius: float,
    box_pos: wp.vec3,
    box_mat: wp.mat33,
    box_size: wp.vec3,
    law: AxisLaw,
    dist_weight: float,
    pos_weight: wp.vec3,
    normal_weight: wp.vec3,
) -> wp.float32:
    """Weighted sum of what `capsule_contact` returns."""
    dist, point, normal = capsule_contact(pos, axis, radius, box_pos, box_mat, box_size, law)
    return dist_weight * dist + wp.dot(pos_weight, point) + wp.dot(normal_weight, normal)
