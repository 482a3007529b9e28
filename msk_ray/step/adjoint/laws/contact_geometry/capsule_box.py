"""How a contact of a capsule with a box moves with both bodies: one smooth law a feature pair, and its pullback.

Their collision is a search for features (corner, edge, face) followed by plain geometry of those found. A contact tells
by where it lies which features these were: the law that reproduces its place on the capsule is the one that made it,
and only that law is differentiated. Candidates are tried from the simplest on, and a later one has to be nearer by more
than rounding. Local axes are signed unit vectors of the box's frame, q points in it.
"""

import warp as wp

from msk_ray.step.adjoint.laws.contact_geometry.contact_point import Bars, ContactPoint, Geom, PairPush
from msk_ray.step.adjoint.laws.contact_geometry.primitive_laws import sphere_box_contact
from msk_ray.step.adjoint.spatial import column, turning_torque
from msk_ray.step.forward.mjw_private import safe_div

wp.set_module_options({"enable_backward": False})

END, EDGE, SPHERE_CORNER, SIDE = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)
"""Places on a capsule's axis: an end, next to a box's edge, next to its corner, over a side plane."""

ROUNDING = wp.constant(2.0e-5)
"""How much nearer, in box sizes, a less simple law must come."""

PARALLEL = wp.constant(1.0e-4)
"""Slopes (sine of an angle) below which two directions do not cross."""


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
def capsule_potential(
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
def axis_law(
    index: int,
    actual: float,
    pos: wp.vec3,
    axis: wp.vec3,
    half: float,
    box_pos: wp.vec3,
    box_mat: wp.mat33,
    box_size: wp.vec3,
) -> AxisLaw:
    """Law of the sphere of contact `index` (0 or 1) seen at a place on the capsule's axis."""
    best = AxisLaw()
    best.end = wp.where(actual > 0.0, half, -half)
    gain = ROUNDING * (half + wp.max(box_size))
    miss = wp.abs(actual - best.end)
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
            error = wp.abs(place - actual)
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
            error = wp.abs(axis_place(pos, axis, box_pos, box_mat, law) - actual)
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
            error = wp.abs(axis_place(pos, axis, box_pos, box_mat, law) - actual)
            if error < miss - gain:
                miss = error
                best = law
    return best


@wp.func
def capsule_box_push(index: int, capsule: Geom, box: Geom, contact: ContactPoint, bars: Bars) -> PairPush:
    """Push of contact `index` (0 or 1) of a capsule and a box, at their centres."""
    axis = column(capsule.mat, 2)
    radius = capsule.size[0]
    # Place on the axis of the sphere whose contact this is: point = centre + n (r + dist / 2)
    centre = contact.point - contact.normal * (radius + 0.5 * contact.dist)
    place = safe_div(wp.dot(centre - capsule.pos, axis), wp.dot(axis, axis))
    law = axis_law(index, place, capsule.pos, axis, capsule.size[1], box.pos, box.mat, box.size)
    pos_bar, axis_bar, _radius, box_pos_bar, box_mat_bar, _size, _law, _dist, _point, _normal = wp.grad(
        capsule_potential
    )(capsule.pos, axis, radius, box.pos, box.mat, box.size, law, bars.dist, bars.point, bars.normal)
    out = PairPush()
    out.force1 = pos_bar
    out.torque1 = wp.cross(axis, axis_bar)
    out.place1 = capsule.pos
    out.force2 = box_pos_bar
    out.torque2 = turning_torque(box.mat, box_mat_bar)
    out.place2 = box.pos
    return out
