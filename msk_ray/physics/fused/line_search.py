"""The exact line search: the least cost on the line a + α s along Newton's direction s."""

import warp as wp

from msk_ray.physics.fused.cones import cone_along, cost_at_start, keep_cone, kept_cone, open_cone
from msk_ray.physics.fused.memory import four, put_four
from msk_ray.physics.fused.problem import World, place
from msk_ray.physics.fused.scratch import Scratch

wp.set_module_options({"enable_backward": False})

_NOISE = wp.constant(8.0 * 1.1920929e-07)
"""Rounding of a sum of a few dozen numbers, as a share of their size, in float32."""
_LEAST_SLOPE = wp.constant(1.0e-6)


@wp.func
def friction_cost(loss: float, edge: float, stiffness: float, jar: float) -> float:
    if jar <= -edge:
        return -loss * (0.5 * edge + jar)
    if jar >= edge:
        return loss * (jar - 0.5 * edge)
    return 0.5 * stiffness * jar * jar


@wp.func
def friction_along(loss: float, stiffness: float, jar: float, rate: float, alpha: float) -> wp.vec3:
    """Cost at α less that at 0, and its derivatives, of a row of friction loss."""
    edge = loss / stiffness
    there = jar + alpha * rate
    cost = friction_cost(loss, edge, stiffness, there) - friction_cost(loss, edge, stiffness, jar)
    if there <= -edge:
        return wp.vec3(cost, -loss * rate, 0.0)
    if there >= edge:
        return wp.vec3(cost, loss * rate, 0.0)
    return wp.vec3(cost, stiffness * there * rate, stiffness * rate * rate)


@wp.func
def spring_along(stiffness: float, jar: float, rate: float, alpha: float) -> wp.vec3:
    """The same of a row that only pushes."""
    there = jar + alpha * rate
    if there >= 0.0:
        return wp.vec3(wp.where(jar < 0.0, -0.5 * stiffness * jar * jar, 0.0), 0.0, 0.0)
    cost = 0.5 * stiffness * there * there
    if jar < 0.0:
        cost = 0.5 * stiffness * alpha * rate * (jar + there)
    return wp.vec3(cost, stiffness * there * rate, stiffness * rate * rate)


@wp.func
def smooth_along(scratch: Scratch, w: World) -> wp.vec2:
    """First and second derivative at α = 0 of what is quadratic everywhere: inertia and equalities."""
    slope = float(0.0)
    curvature = float(0.0)
    for k in range(w.blocks):
        s = four(scratch.direction, w.id, k)
        slope += wp.dot(s, four(scratch.inertial, w.id, k) - four(scratch.smooth, w.id, k))
        curvature += wp.dot(s, four(scratch.moved, w.id, k))
    for scalar in range(wp.min(w.equalities, w.scalars)):
        row = four(scratch.springs, w.id, place(w, scalar))
        slope += row[0] * row[2] * row[3]
        curvature += row[0] * row[3] * row[3]
    return wp.vec2(slope, curvature)


@wp.func
def scalars_along(scratch: Scratch, w: World, alpha: float) -> wp.vec3:
    """Cost at α less that at 0, and its derivatives, of the rows that are neither equalities nor elliptic contacts."""
    total = wp.vec3(0.0)
    for scalar in range(w.equalities, w.scalars):
        row = four(scratch.springs, w.id, place(w, scalar))
        if scalar < w.equalities + w.frictions:
            total += friction_along(row[1], row[0], row[2], row[3], alpha)
        else:
            total += spring_along(row[0], row[2], row[3], alpha)
    return total


@wp.func
def scalars_cost(scratch: Scratch, w: World) -> float:
    """Cost of the same rows at α = 0."""
    cost = float(0.0)
    for scalar in range(w.equalities, w.scalars):
        row = four(scratch.springs, w.id, place(w, scalar))
        if scalar < w.equalities + w.frictions:
            cost += friction_cost(row[1], row[1] / row[0], row[0], row[2])
        elif row[2] < 0.0:
            cost += 0.5 * row[0] * row[2] * row[2]
    return cost


@wp.func
def cost_along(scratch: Scratch, w: World, smooth: wp.vec2, alpha: float) -> wp.vec3:
    """Cost at α less that at 0, and its first and second derivative."""
    total = scalars_along(scratch, w, alpha)
    for contact in range(w.contacts):
        total += cone_along(kept_cone(scratch, w.id, contact), alpha)
    bent = alpha * smooth[1]
    return total + wp.vec3(alpha * (smooth[0] + 0.5 * bent), smooth[0] + bent, smooth[1])


@wp.func
def open_rows(scratch: Scratch, w: World, begin: int, end: int) -> None:
    """J s of some rows, four at a time."""
    for p in range(begin, end, 4):
        last = end - 1
        rates = wp.vec4(0.0)
        for k in range(w.blocks):
            s = four(scratch.direction, w.id, k)
            rates += wp.vec4(
                wp.dot(four(scratch.rows, w.id, p * w.blocks + k), s),
                wp.dot(four(scratch.rows, w.id, wp.min(p + 1, last) * w.blocks + k), s),
                wp.dot(four(scratch.rows, w.id, wp.min(p + 2, last) * w.blocks + k), s),
                wp.dot(four(scratch.rows, w.id, wp.min(p + 3, last) * w.blocks + k), s),
            )
        for i in range(4):
            if p + i < end:
                row = four(scratch.springs, w.id, p + i)
                put_four(scratch.springs, w.id, p + i, wp.vec4(row[0], row[1], row[2], rates[i]))


@wp.func
def search_line(scratch: Scratch, w: World, least: float, limit: int) -> tuple[float, float, bool]:
    """Newton's method for the zero of the cost's slope, which halves its bracket where it does not halve the slope.

    Args:
        least: the slope below which a point counts as the least; rounding of the slope may raise it.
        limit: of evaluations.

    Returns:
        α, by how much it lowers the cost, and whether it was found within the limit.
    """
    open_rows(scratch, w, 0, w.contact_rows)
    open_rows(scratch, w, w.room - w.scalars, w.room)
    smooth = smooth_along(scratch, w)
    start = wp.vec3(0.0) + scalars_along(scratch, w, 0.0)
    cost = scalars_cost(scratch, w)
    for contact in range(w.contacts):
        cone = open_cone(scratch, w.id, contact)
        keep_cone(scratch, w.id, contact, cone)
        start += cone_along(cone, 0.0)
        cost += cost_at_start(cone)
    slope = start[1] + smooth[0]
    curvature = start[2] + smooth[1]
    # Of a sum of squares, |Σ D jar rate| <= √(2 cost curvature): the size of the numbers that the slope adds up.
    size = wp.sqrt(2.0 * cost * start[2]) + wp.abs(smooth[0])
    enough = wp.max(wp.max(least, _LEAST_SLOPE), _NOISE * size)
    best = float(0.0)
    gain = float(0.0)
    if not (slope < -_NOISE * size):
        return best, gain, True
    low = float(0.0)
    high = float(-1.0)
    before = -slope
    alpha = before / curvature
    for _evaluation in range(limit):
        point = cost_along(scratch, w, smooth, alpha)
        steep = wp.abs(point[1])
        if steep < enough:
            if point[0] < 0.0:
                best = alpha
                gain = point[0]
            return best, -gain, True
        if point[0] < gain:
            best = alpha
            gain = point[0]
        if point[1] < 0.0:
            low = alpha
        else:
            high = alpha
        alpha -= point[1] / point[2]
        if high > 0.0 and not (alpha > low and alpha < high and 2.0 * steep < before):
            alpha = 0.5 * (low + high)
        before = steep
        if alpha == low or alpha == high:
            return best, -gain, True
    return best, -gain, False
