"""How a contact of two convex geoms moves with both, pulled back: two laws for all pairs.

`touching_wrenches`: patches that touch away from faces. Points a and b of the two surfaces lie on one normal n, from
the first geom to the second, at the distance d. With the velocity u of the bodies' material, their spins ω, the motion
s of each point along its surface, and g = u₂(b) - u₁(a) in the tangent plane,

    s₁ = ρ₁ (δn - ω₁×n) ,  s₂ = ρ₂ (δn - ω₂×n) ,  s₁ + s₂ + d δn = g ,  δd = n·(u₂(b) - u₁(a)).

`flat_wrenches`: a point of one geom above a face of the other, which gives the normal.
"""

import warp as wp

from msk_ray.step.adjoint.laws.contact_geometry.contact_point import Bars, ContactPoint
from msk_ray.step.adjoint.laws.contact_geometry.patches import EDGE, Patch
from msk_ray.step.forward.mjw_private import make_frame

wp.set_module_options({"enable_backward": False})

_SINGULAR = wp.constant(1.0e-5)
"""Pivot, of rows of order one, below which the laws leave a motion open."""


@wp.struct
class Push:
    """Forces on the two geoms and torques about the contact's point."""

    force1: wp.vec3
    torque1: wp.vec3
    force2: wp.vec3
    torque2: wp.vec3


@wp.func
def added(push: Push, other: Push) -> Push:
    """The sum of two pushes on the same geoms, about the same point."""
    out = Push()
    out.force1 = push.force1 + other.force1
    out.torque1 = push.torque1 + other.torque1
    out.force2 = push.force2 + other.force2
    out.torque2 = push.torque2 + other.torque2
    return out


@wp.func
def swapped(push: Push) -> Push:
    """The push with the two geoms exchanged."""
    out = Push()
    out.force1 = push.force2
    out.torque1 = push.torque2
    out.force2 = push.force1
    out.torque2 = push.torque1
    return out


@wp.func
def solved(matrix: wp.mat44, right: wp.vec4) -> tuple[wp.vec4, wp.bool]:
    """The solution of a linear system, and whether it has one; a motion that is left open is taken as zero."""
    a = matrix
    b = right
    regular = bool(True)
    taken = wp.vec4(-1.0)  # column whose pivot is in a row
    for column in range(4):
        row = int(-1)
        most = float(_SINGULAR)
        for i in range(4):
            if taken[i] < 0.0 and wp.abs(a[i, column]) > most:
                most = wp.abs(a[i, column])
                row = i
        if row < 0:
            regular = bool(False)
        else:
            taken[row] = float(column)
            for i in range(4):
                if i != row:
                    factor = a[i, column] / a[row, column]
                    a[i] = a[i] - factor * a[row]
                    b[i] = b[i] - factor * b[row]
    x = wp.vec4(0.0)
    for i in range(4):
        if taken[i] >= 0.0:
            x[int(taken[i])] = b[i] / a[i, int(taken[i])]
    return x, regular


@wp.func
def in_plane(vector: wp.vec3, t1: wp.vec3, t2: wp.vec3) -> wp.vec2:
    """Coordinates of a vector in a plane."""
    return wp.vec2(wp.dot(vector, t1), wp.dot(vector, t2))


@wp.func
def plane_matrix(matrix: wp.mat33, t1: wp.vec3, t2: wp.vec3) -> wp.mat22:
    """A symmetric map of a plane to itself in the plane's coordinates."""
    mixed = wp.dot(t1, matrix @ t2)
    return wp.mat22(wp.dot(t1, matrix @ t1), mixed, mixed, wp.dot(t2, matrix @ t2))


@wp.func
def radii(patch: Patch, t1: wp.vec3, t2: wp.vec3, length: float) -> tuple[wp.mat22, wp.mat22]:
    """(C, Q) with C s = Q l (δn - ω×n), l the unit of length: C⁻¹ Q is ρ / l, and C is singular where ρ is infinite.

    The rows are of order one.
    """
    c = wp.identity(n=2, dtype=float)
    q = plane_matrix(patch.bend, t1, t2) / length
    if patch.kind == EDGE:
        run = wp.normalize(in_plane(patch.run, t1, t2))
        across = wp.vec2(-run[1], run[0])
        c = wp.outer(across, across)
        q = wp.outer(run, run) + wp.dot(across, q @ across) * c
    return c, q


@wp.func
def touching_wrenches(
    patch1: Patch, patch2: Patch, contact: ContactPoint, bars: Bars, length: float
) -> tuple[Push, wp.bool]:
    """Pullback of two patches' contact, none of them a face, and whether the contact has a derivative.

    It has none where two edges are parallel, or where the centres of curvature meet.

    Args:
        length: unit of length, of the order of the geoms' sizes.
    """
    n = contact.normal
    frame = make_frame(n)
    t1 = frame[1]
    t2 = frame[2]
    d = contact.dist
    c1, q1 = radii(patch1, t1, t2, length)
    c2, q2 = radii(patch2, t1, t2, length)
    # Unknowns l δn and s₂; s₁ = g - d δn - s₂ :
    #   (Q₁ + d/l C₁) l δn + C₁ s₂ = C₁ g + Q₁ l ω₁×n ,    Q₂ l δn - C₂ s₂ = Q₂ l ω₂×n
    top = q1 + (d / length) * c1
    # Transposed: the matrices C and Q are symmetric, the blocks change places.
    transposed = wp.matrix_from_rows(
        wp.vec4(top[0, 0], top[0, 1], q2[0, 0], q2[0, 1]),
        wp.vec4(top[1, 0], top[1, 1], q2[1, 0], q2[1, 1]),
        wp.vec4(c1[0, 0], c1[0, 1], -c2[0, 0], -c2[0, 1]),
        wp.vec4(c1[1, 0], c1[1, 1], -c2[1, 0], -c2[1, 1]),
    )
    # δp = ½ (u₁ + u₂ + g - d δn) - s₂
    point_bar = in_plane(bars.point, t1, t2)
    turn_bar = (in_plane(bars.normal, t1, t2) - (0.5 * d) * point_bar) / length
    y, regular = solved(transposed, wp.vec4(turn_bar[0], turn_bar[1], -point_bar[0], -point_bar[1]))
    y1 = wp.vec2(y[0], y[1])
    y2 = wp.vec2(y[2], y[3])
    gap_bar = c1 @ y1 + 0.5 * point_bar
    spin1 = length * (q1 @ y1)
    spin2 = length * (q2 @ y2)
    pull = bars.dist * n + gap_bar[0] * t1 + gap_bar[1] * t2
    push = Push()
    push.force1 = 0.5 * bars.point - pull
    push.force2 = 0.5 * bars.point + pull
    # a and b lie half the distance off the point; ω×n in the plane ⇒ torque n × its cotangent
    push.torque1 = wp.cross(n, -0.5 * d * push.force1 + spin1[0] * t1 + spin1[1] * t2)
    push.torque2 = wp.cross(n, 0.5 * d * push.force2 + spin2[0] * t1 + spin2[1] * t2)
    return push, regular


@wp.struct
class Foot:
    """A point v of one geom above a face of the other, and what the face's plane is to the contact.

    Relative to the face's body v moves by T (g + B δm): g is the velocity of the geom's material at v, and δm the turn
    of its outward normal m there, relative to its own body.
    """

    place: wp.vec3
    bend: wp.mat33
    """B [m]."""
    slide: wp.mat33
    """T: along the geom, so that v stays on a plane or a line of the face's body."""
    line: wp.int32
    """1: v is on a capsule's side, at an offset from the axis that another feature than the face has set."""


@wp.func
def flat_wrenches(foot: Foot, plane: wp.vec3, contact: ContactPoint, bars: Bars, turns_with_other: int) -> Push:
    """Pullback of a contact whose first geom has the face.

    Args:
        foot: of the second geom.
        plane: outward normal of the face, N.
        contact: its normal n, which points from the first geom to the second, is N or nearly.
        bars: cotangents.
        turns_with_other: 1 where n belongs to the second geom, a face of which lies on the first's.
    """
    n = contact.normal
    cosine = wp.dot(plane, n)
    d = contact.dist
    height = d / cosine
    # dist = h N·n ,  point = v - h N + ½ d n ,  δh = N·r ,  r = T (g + B δm) ,  δm = -(ω₁ - ω₂)×N
    reach = bars.dist + 0.5 * wp.dot(bars.point, n)
    moved_bar = (reach * cosine - wp.dot(bars.point, plane)) * plane + bars.point
    gap_bar = wp.transpose(foot.slide) @ moved_bar
    turn = wp.cross(plane, wp.transpose(foot.bend) @ gap_bar)
    tilt = (reach * height) * wp.cross(plane, n)
    push = Push()
    push.force1 = bars.point - gap_bar
    push.force2 = gap_bar
    arm = foot.place - contact.point
    push.torque1 = wp.cross(arm, push.force1) - turn + tilt - height * wp.cross(plane, bars.point)
    push.torque2 = wp.cross(arm, push.force2) + turn
    normal_torque = wp.cross(n, bars.normal + 0.5 * d * bars.point) - tilt
    if turns_with_other == 1:
        push.torque2 += normal_torque
    else:
        push.torque1 += normal_torque
    return push


@wp.func
def height_wrenches(place: wp.vec3, plane: wp.vec3, contact: ContactPoint, dist_bar: float) -> Push:
    """Pullback of a distance that is the height of a point of the second geom above a face of the first."""
    push = Push()
    push.force2 = dist_bar * plane
    push.force1 = -push.force2
    push.torque2 = wp.cross(place - contact.point, push.force2)
    push.torque1 = -push.torque2
    return push
