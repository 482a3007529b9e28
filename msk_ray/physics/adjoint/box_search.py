"""Which law of `box_laws` made a contact: each candidate predicts the contact, and the nearest prediction wins.

Candidates are tried from the simplest on, and a later one has to be nearer by more than rounding, so that a corner that
happens to lie on a clipping plane stays a corner.
"""

import warp as wp

from msk_ray.physics.adjoint.box_laws import (
    CROSSING,
    EDGE,
    FACE_POINT,
    SIDE,
    SPHERE_CORNER,
    AxisLaw,
    EdgeLaw,
    FaceLaw,
    PointLaw,
    axis_place,
    edge_contact,
    face_contact,
    point_contact,
)
from msk_ray.physics.mjw_private import safe_div

wp.set_module_options({"enable_backward": False})

ROUNDING = wp.constant(2.0e-5)
"""How much nearer, in box sizes, a less simple law must come."""

PARALLEL = wp.constant(1.0e-4)
"""Slopes (sine of an angle) below which two directions do not cross."""

LYING = wp.constant(0.996)
"""Cosine above which MuJoCo's convex collision takes two faces as lying on each other (5 degrees)."""

NO_LAW, BY_FACE, BY_EDGES, BY_POINTS = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)


@wp.func
def unit(axis: int, sign: float) -> wp.vec3:
    """Signed unit vector of a local axis."""
    out = wp.vec3(0.0)
    out[axis] = sign
    return out


@wp.func
def side_of(x: float) -> float:
    """Sign of a number, +1 for zero."""
    return wp.where(x >= 0.0, 1.0, -1.0)


@wp.func
def corner(size: wp.vec3, i: int, si: float, j: int, sj: float, k: int, sk: float) -> wp.vec3:
    """Local point with coordinates s·size; a sign of zero leaves a coordinate out."""
    out = wp.vec3(0.0)
    out[i] = si * size[i]
    out[j] = sj * size[j]
    out[k] = sk * size[k]
    return out


@wp.func
def most_along(mat: wp.mat33, direction: wp.vec3) -> int:
    """Local axis that lies most along a direction."""
    local = wp.transpose(mat) @ direction
    best = int(0)
    for i in range(1, 3):
        if wp.abs(local[i]) > wp.abs(local[best]):
            best = i
    return best


@wp.func
def axis_law(
    index: int,
    seen: float,
    pos: wp.vec3,
    axis: wp.vec3,
    half: float,
    box_pos: wp.vec3,
    box_mat: wp.mat33,
    box_size: wp.vec3,
) -> AxisLaw:
    """Law of the sphere of contact `index` (0 or 1) seen at a place on the capsule's axis."""
    best = AxisLaw()
    best.end = wp.where(seen > 0.0, half, -half)
    gain = ROUNDING * (half + wp.max(box_size))
    miss = wp.abs(seen - best.end)
    # Features of the box that can be nearest: 12 edges and their corners, each with the segments' clamping.
    nearest = float(1.0e10)
    base = AxisLaw()
    base.end = best.end
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        for corners in range(4):
            q = corner(box_size, i, wp.where(corners % 2 == 0, 1.0, -1.0), j, wp.where(corners < 2, 1.0, -1.0), k, 0.0)
            law = AxisLaw()
            law.place = EDGE
            law.q = q
            law.run = unit(k, 1.0)
            run = box_mat @ law.run
            gap = box_pos + box_mat @ q - pos
            b = wp.dot(axis, run)
            if 1.0 - b * b < PARALLEL * PARALLEL:
                continue
            place = (wp.dot(axis, gap) - b * wp.dot(run, gap)) / (1.0 - b * b)
            along = b * place - wp.dot(run, gap)
            if wp.abs(along) > box_size[k]:
                law.place = SPHERE_CORNER
                law.q = q + unit(k, side_of(along) * box_size[k])
                along = side_of(along) * box_size[k]
                place = wp.dot(axis, gap + along * run)
            if wp.abs(place) > half:
                law = AxisLaw()
                law.end = side_of(place) * half
                place = law.end
                along = wp.clamp(b * place - wp.dot(run, gap), -box_size[k], box_size[k])
            error = wp.abs(place - seen)
            if index == 0 and error < miss - gain:
                miss = error
                best = law
            distance = wp.length(gap + along * run - place * axis)
            if distance < nearest:
                nearest = distance
                base = law
    if index == 0:
        return best

    # The second sphere: over a side plane of the nearest face ...
    for k in range(3):
        for signs in range(2):
            law = AxisLaw()
            law.place = SIDE
            law.side = unit(k, 1.0)
            law.cut = wp.where(signs == 0, box_size[k], -box_size[k])
            if wp.abs(wp.dot(box_mat @ law.side, axis)) < PARALLEL:
                continue
            error = wp.abs(axis_place(pos, axis, box_pos, box_mat, law) - seen)
            if error < miss - gain:
                miss = error
                best = law
    # ... or a width of the box away from the first.
    for k in range(3):
        if wp.abs(wp.dot(box_mat @ unit(k, 1.0), axis)) < PARALLEL:
            continue
        for way in range(6):
            law = base
            law.shift_axis = unit(k, 1.0)
            sign = wp.where(way % 2 == 0, 1.0, -1.0)
            law.shift = sign * 2.0 * box_size[k]
            if way >= 2:
                # From the place along the edge to the edge's end.
                if base.place != EDGE or base.run[k] == 0.0:
                    continue
                law.shift = sign * box_size[k]
                law.shift_along_edge = sign * wp.where(way < 4, 1.0, -1.0)
            error = wp.abs(axis_place(pos, axis, box_pos, box_mat, law) - seen)
            if error < miss - gain:
                miss = error
                best = law
    return best


@wp.func
def mismatch(size: float, point: wp.vec3, normal: wp.vec3, seen_point: wp.vec3, seen_normal: wp.vec3) -> float:
    """How far a prediction is from the contact: in sizes for the point, in radians for the normal."""
    return wp.length(point - seen_point) / size + wp.length(normal - seen_normal)


@wp.func
def face_law(
    pos_ref: wp.vec3,
    mat_ref: wp.mat33,
    size_ref: wp.vec3,
    pos_inc: wp.vec3,
    mat_inc: wp.mat33,
    size_inc: wp.vec3,
    seen_point: wp.vec3,
    seen_normal: wp.vec3,
    size: float,
    may_lie: int,
) -> tuple[FaceLaw, wp.float32]:
    """Best law with the reference box's face, and its mismatch; the normal seen points away from the reference."""
    a = most_along(mat_ref, seen_normal)
    a_sign = side_of(wp.dot(mat_ref @ unit(a, 1.0), seen_normal))
    b = most_along(mat_inc, mat_ref @ unit(a, 1.0))
    b_sign = -side_of(wp.dot(mat_inc @ unit(b, 1.0), mat_ref @ unit(a, a_sign)))
    law = FaceLaw()
    law.normal_ref = unit(a, a_sign)
    law.offset_ref = size_ref[a]
    law.normal_inc = unit(b, b_sign)
    law.offset_inc = size_inc[b]
    if may_lie == 1 and wp.dot(mat_ref @ law.normal_ref, mat_inc @ law.normal_inc) < -LYING:
        law.along_inc = 1
    best = law
    miss = float(1.0e10)
    u = (b + 1) % 3
    v = (b + 2) % 3
    for signs in range(4):
        su = wp.where(signs % 2 == 0, 1.0, -1.0)
        sv = wp.where(signs < 2, 1.0, -1.0)
        law.vertex = 0
        law.q_inc = corner(size_inc, b, b_sign, u, su, v, sv)
        _dist, point, normal = face_contact(pos_ref, mat_ref, pos_inc, mat_inc, law)
        error = mismatch(size, point, normal, seen_point, seen_normal)
        if error < miss - ROUNDING:
            miss = error
            best = law
    for fixed in range(2):
        held = wp.where(fixed == 0, u, v)
        free = wp.where(fixed == 0, v, u)
        for signs in range(2):
            law.vertex = CROSSING
            law.q_inc = corner(size_inc, b, b_sign, held, wp.where(signs == 0, 1.0, -1.0), free, 0.0)
            law.run = unit(free, 1.0)
            for plane in range(4):
                k = (a + 1 + plane % 2) % 3
                law.side = unit(k, 1.0)
                law.cut = wp.where(plane < 2, size_ref[k], -size_ref[k])
                if wp.abs(wp.dot(mat_ref @ law.side, mat_inc @ law.run)) < PARALLEL:
                    continue
                _dist, point, normal = face_contact(pos_ref, mat_ref, pos_inc, mat_inc, law)
                error = mismatch(size, point, normal, seen_point, seen_normal)
                if error < miss - ROUNDING:
                    miss = error
                    best = law
    if wp.abs(wp.dot(mat_ref @ law.normal_ref, mat_inc @ law.normal_inc)) > PARALLEL:
        i = (a + 1) % 3
        j = (a + 2) % 3
        for signs in range(4):
            law.vertex = FACE_POINT
            law.q_ref = corner(
                size_ref, a, a_sign, i, wp.where(signs % 2 == 0, 1.0, -1.0), j, wp.where(signs < 2, 1.0, -1.0)
            )
            _dist, point, normal = face_contact(pos_ref, mat_ref, pos_inc, mat_inc, law)
            error = mismatch(size, point, normal, seen_point, seen_normal)
            if error < miss - ROUNDING:
                miss = error
                best = law
    return best, miss


@wp.func
def deepest_corner_law(
    mat_ref: wp.mat33, size_ref: wp.vec3, mat_inc: wp.mat33, size_inc: wp.vec3, normal: wp.vec3
) -> FaceLaw:
    """Law of the other box's corner that reaches farthest against the reference face along a normal."""
    a = most_along(mat_ref, normal)
    law = FaceLaw()
    law.normal_ref = unit(a, side_of(wp.dot(mat_ref @ unit(a, 1.0), normal)))
    law.offset_ref = size_ref[a]
    law.normal_inc = unit(0, 1.0)
    against = wp.transpose(mat_inc) @ (mat_ref @ law.normal_ref)
    law.q_inc = corner(size_inc, 0, -side_of(against[0]), 1, -side_of(against[1]), 2, -side_of(against[2]))
    return law


@wp.func
def edge_law(
    i: int, j: int, mat1: wp.mat33, size1: wp.vec3, mat2: wp.mat33, size2: wp.vec3, seen_normal: wp.vec3
) -> EdgeLaw:
    """Law of the edges along axis i of box 1 and j of box 2 that support their common normal."""
    law = EdgeLaw()
    law.edge1 = unit(i, 1.0)
    law.edge2 = unit(j, 1.0)
    normal = wp.cross(mat1 @ law.edge1, mat2 @ law.edge2)
    law.sign = side_of(wp.dot(normal, seen_normal))
    outward = law.sign * normal
    local1 = wp.transpose(mat1) @ outward
    local2 = wp.transpose(mat2) @ outward
    i1 = (i + 1) % 3
    i2 = (i + 2) % 3
    j1 = (j + 1) % 3
    j2 = (j + 2) % 3
    law.q1 = corner(size1, i, 0.0, i1, side_of(local1[i1]), i2, side_of(local1[i2]))
    law.q2 = corner(size2, j, 0.0, j1, -side_of(local2[j1]), j2, -side_of(local2[j2]))
    return law


@wp.func
def edges_cross(i: int, j: int, mat1: wp.mat33, mat2: wp.mat33) -> bool:
    """Whether axis i of box 1 and axis j of box 2 are not parallel."""
    return wp.length(wp.cross(mat1 @ unit(i, 1.0), mat2 @ unit(j, 1.0))) > PARALLEL


@wp.func
def points_law(
    pos1: wp.vec3, mat1: wp.mat33, size1: wp.vec3, pos2: wp.vec3, mat2: wp.mat33, size2: wp.vec3, normal: wp.vec3
) -> PointLaw:
    """Law of two corners that face each other along a normal; the caller lets one of them slide."""
    law = PointLaw()
    local1 = wp.transpose(mat1) @ normal
    local2 = wp.transpose(mat2) @ normal
    law.q1 = corner(size1, 0, side_of(local1[0]), 1, side_of(local1[1]), 2, side_of(local1[2]))
    law.q2 = corner(size2, 0, -side_of(local2[0]), 1, -side_of(local2[1]), 2, -side_of(local2[2]))
    return law


@wp.func
def box_laws(
    pos1: wp.vec3,
    mat1: wp.mat33,
    size1: wp.vec3,
    pos2: wp.vec3,
    mat2: wp.mat33,
    size2: wp.vec3,
    seen_dist: float,
    seen_point: wp.vec3,
    seen_normal: wp.vec3,
    native_ccd: int,
) -> tuple[wp.int32, wp.int32, FaceLaw, EdgeLaw, PointLaw, wp.int32, wp.int32, FaceLaw, EdgeLaw]:
    """Laws of a contact of two boxes.

    Returns (kind, owner, face, edge, point): the law of point and normal, with `owner` 1 or 2 the reference box of a
    face; then (dist_kind, dist_owner, dist_face, dist_edge), the law of the distance, NO_LAW where it is the same.
    """
    size = 0.5 * (wp.max(size1) + wp.max(size2))
    kind = int(NO_LAW)
    owner = int(1)
    face, miss = face_law(pos1, mat1, size1, pos2, mat2, size2, seen_point, seen_normal, size, native_ccd)
    kind = BY_FACE
    other, error = face_law(pos2, mat2, size2, pos1, mat1, size1, seen_point, -seen_normal, size, 0)
    if error < miss - ROUNDING:
        miss = error
        face = other
        owner = 2
    upright, error = face_law(pos1, mat1, size1, pos2, mat2, size2, seen_point, seen_normal, size, 0)
    if error < miss - ROUNDING:
        miss = error
        face = upright
        owner = 1
    edge = EdgeLaw()
    for i in range(3):
        for j in range(3):
            if edges_cross(i, j, mat1, mat2):
                crossing = edge_law(i, j, mat1, size1, mat2, size2, seen_normal)
                _dist, point, normal = edge_contact(pos1, mat1, pos2, mat2, crossing)
                error = mismatch(size, point, normal, seen_point, seen_normal)
                if error < miss - ROUNDING:
                    miss = error
                    edge = crossing
                    kind = BY_EDGES
    points = PointLaw()
    if seen_dist > 0.0:
        corners = points_law(pos1, mat1, size1, pos2, mat2, size2, seen_normal)
        for slide in range(7):
            sliding = corners
            if slide >= 1 and slide < 4:
                sliding.run1 = unit(slide - 1, 1.0)
            if slide >= 4:
                sliding.run2 = unit(slide - 4, 1.0)
            _dist, point, normal = point_contact(pos1, mat1, pos2, mat2, sliding)
            error = mismatch(size, point, normal, seen_point, seen_normal)
            if error < miss - ROUNDING:
                miss = error
                points = sliding
                kind = BY_POINTS

    dist_kind = int(NO_LAW)
    dist_owner = int(1)
    dist_face = FaceLaw()
    dist_edge = EdgeLaw()
    if kind == BY_FACE and native_ccd == 1:
        # Clipping that leaves one vertex keeps the distance found before clipping.
        if owner == 1:
            dist, _p, _n = face_contact(pos1, mat1, pos2, mat2, face)
        else:
            dist, _p, _n = face_contact(pos2, mat2, pos1, mat1, face)
        miss = wp.abs(dist - seen_dist) / size
        first = deepest_corner_law(mat1, size1, mat2, size2, seen_normal)
        dist, _p, _n = face_contact(pos1, mat1, pos2, mat2, first)
        error = wp.abs(dist - seen_dist) / size
        if error < miss - ROUNDING:
            miss = error
            dist_kind = BY_FACE
            dist_face = first
        second = deepest_corner_law(mat2, size2, mat1, size1, -seen_normal)
        dist, _p, _n = face_contact(pos2, mat2, pos1, mat1, second)
        error = wp.abs(dist - seen_dist) / size
        if error < miss - ROUNDING:
            miss = error
            dist_kind = BY_FACE
            dist_face = second
            dist_owner = 2
        for i in range(3):
            for j in range(3):
                if edges_cross(i, j, mat1, mat2):
                    crossing = edge_law(i, j, mat1, size1, mat2, size2, seen_normal)
                    dist, _p, _n = edge_contact(pos1, mat1, pos2, mat2, crossing)
                    error = wp.abs(dist - seen_dist) / size
                    if error < miss - ROUNDING:
                        miss = error
                        dist_kind = BY_EDGES
                        dist_edge = crossing
    return kind, owner, face, edge, points, dist_kind, dist_owner, dist_face, dist_edge


@wp.func
def capsule_seen_at(pos: wp.vec3, axis: wp.vec3, radius: float, dist: float, point: wp.vec3, normal: wp.vec3) -> float:
    """Place on the capsule's axis of the sphere whose contact with a box this is."""
    # point = centre + n (r + dist / 2)
    return safe_div(wp.dot(point - normal * (radius + 0.5 * dist) - pos, axis), wp.dot(axis, axis))
