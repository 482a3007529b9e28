"""Tendon paths inside a wrapping geom: how the point where they touch moves.

A path from e₀ to e₁ touches the inside of a circle of radius r where its length is stationary. At p = r(cos θ, sin θ),
with t = dp/dθ and the unit vectors uᵢ from p to eᵢ,

    g(θ; e₀, e₁) = -(u₀ + u₁)·t = 0   ⇒   dθ = -∂g/∂e · de / (∂g/∂θ)

whatever iterations have found θ. On a cylinder this holds in the plane across it.
"""

import warp as wp

from msk_ray.step.forward.mjw_private import WrapType

wp.set_module_options({"enable_backward": False})

_UNFOUND = wp.constant(1.0e-3)
"""|g|/r above which mujoco_warp's search has ended without a solution, and returned the middle instead."""


@wp.struct
class InsidePlane:
    """The circle's plane through its centre, and both ends in it."""

    axis0: wp.vec3
    axis1: wp.vec3
    end0: wp.vec2
    end1: wp.vec2


@wp.func
def inside_plane(start: wp.vec3, end: wp.vec3, kind: wp.int32) -> InsidePlane:
    """The plane of a path between two points in the geom's frame, as mujoco_warp's `wrap` chooses it."""
    plane = InsidePlane()
    plane.axis0 = wp.vec3(1.0, 0.0, 0.0)
    plane.axis1 = wp.vec3(0.0, 1.0, 0.0)
    if kind == WrapType.SPHERE:
        plane.axis0 = wp.normalize(start)
        plane.axis1 = wp.normalize(wp.cross(wp.cross(start, end), start))
    plane.end0 = wp.vec2(wp.dot(start, plane.axis0), wp.dot(start, plane.axis1))
    plane.end1 = wp.vec2(wp.dot(end, plane.axis0), wp.dot(end, plane.axis1))
    return plane


@wp.func
def inside_place(
    start: wp.vec3, end: wp.vec3, pos: wp.vec3, mat: wp.mat33, radius: wp.float32, kind: wp.int32, touch: wp.vec3
) -> wp.vec3:
    """Where a path touches the circle, in the circle's plane, and ∂g/∂θ there.

    The slope is 0 where mujoco_warp has found no solution.
    """
    back = wp.transpose(mat)
    plane = inside_plane(back @ (start - pos), back @ (end - pos), kind)
    local = back @ (touch - pos)
    point = wp.vec2(wp.dot(local, plane.axis0), wp.dot(local, plane.axis1))
    tangent = wp.vec2(-point[1], point[0])
    g = pull_along(plane.end0, point, tangent) + pull_along(plane.end1, point, tangent)
    slope = pull_slope(plane.end0, point, tangent) + pull_slope(plane.end1, point, tangent)
    if wp.abs(g) > _UNFOUND * radius:
        slope = 0.0
    return wp.vec3(point[0], point[1], slope)


@wp.func
def pull_along(end: wp.vec2, point: wp.vec2, tangent: wp.vec2) -> wp.float32:
    """u·t of one end."""
    return wp.dot(wp.normalize(end - point), tangent)


@wp.func
def pull_slope(end: wp.vec2, point: wp.vec2, tangent: wp.vec2) -> wp.float32:
    """-d(u·t)/dθ of one end: (t·t - (u·t)²)/|e - p| + u·p, because dp = t dθ and dt = -p dθ."""
    away = end - point
    length = wp.length(away)
    along = wp.dot(away, tangent) / length
    return (wp.dot(tangent, tangent) - along * along) / length + wp.dot(away, point) / length


@wp.func
def inside_potential(
    start: wp.vec3,
    end: wp.vec3,
    pos: wp.vec3,
    mat: wp.mat33,
    radius: wp.float32,
    kind: wp.int32,
    place: wp.vec3,
    weight: wp.vec3,
) -> wp.float32:
    """⟨weight, point⟩ for the touching point, one Newton step from where it was found: exact in its first derivative.

    Args:
        place: as `inside_place` gives it, held fixed; without a slope, the point is the middle of both ends.
    """
    back = wp.transpose(mat)
    first = back @ (start - pos)
    last = back @ (end - pos)
    plane = inside_plane(first, last, kind)
    point = radius * wp.normalize(plane.end0 + plane.end1)
    if place[2] != 0.0:
        rim = wp.vec2(place[0], place[1])
        rim = rim * (radius / wp.length(rim))  # the circle may grow
        tangent = wp.vec2(-rim[1], rim[0])
        g = -pull_along(plane.end0, rim, tangent) - pull_along(plane.end1, rim, tangent)
        # To first order in g, which is zero here but for rounding.
        point = rim - tangent * (g / place[2])
    local = plane.axis0 * point[0] + plane.axis1 * point[1]
    if kind == WrapType.CYLINDER:
        length0 = wp.length(plane.end0 - point)
        length1 = wp.length(plane.end1 - point)
        local[2] = first[2] + (last[2] - first[2]) * length0 / (length0 + length1)
    return wp.dot(weight, mat @ local + pos)
