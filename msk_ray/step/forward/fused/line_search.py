"""The exact line search: minimises the cost along a + α s, with Newton's direction s."""

import warp as wp

from msk_ray.step.forward.fused.cones import cone_along, cost_at_start, keep_cone, kept_cone, open_cone
from msk_ray.step.forward.fused.lanes import at, four, lane_count, lane_sum, lane_sums, lane_sync, put, whole
from msk_ray.step.forward.fused.problem import Rows, World
from msk_ray.step.forward.fused.scratch import Scratch
from msk_ray.step.forward.mjw_private import ConstraintType

wp.set_module_options({"enable_backward": False})

_ELLIPTIC = wp.constant(int(ConstraintType.CONTACT_ELLIPTIC))
_NOISE = wp.constant(8.0 * 1.1920929e-07)
"""Relative rounding of a float32 sum of a few dozen numbers."""
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
    """Cost at α minus cost at 0 of a friction-loss row, and its derivatives."""
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
    """The same for a row that only pushes."""
    there = jar + alpha * rate
    if there >= 0.0:
        return wp.vec3(wp.where(jar < 0.0, -0.5 * stiffness * jar * jar, 0.0), 0.0, 0.0)
    cost = 0.5 * stiffness * there * there
    if jar < 0.0:
        cost = 0.5 * stiffness * alpha * rate * (jar + there)
    return wp.vec3(cost, stiffness * there * rate, stiffness * rate * rate)


@wp.func
def row_along(rows: Rows, scratch: Scratch, w: World, r: int, alpha: float) -> wp.vec3:
    """Cost at α minus cost at 0 of a row that is not an equality, and its derivatives; 0 for rows of elliptic
    contacts."""
    if whole(rows.type[w.id], r) == _ELLIPTIC:
        return wp.vec3(0.0)
    stiffness = at(rows.D[w.id], r)
    jar = at(scratch.jar[w.id], r)
    rate = at(scratch.rate[w.id], r)
    if r < w.equalities + w.frictions:
        return friction_along(at(rows.frictionloss[w.id], r), stiffness, jar, rate, alpha)
    return spring_along(stiffness, jar, rate, alpha)


@wp.func
def row_cost(rows: Rows, scratch: Scratch, w: World, r: int) -> float:
    """Cost of the same row at α = 0."""
    stiffness = at(rows.D[w.id], r)
    jar = at(scratch.jar[w.id], r)
    if whole(rows.type[w.id], r) == _ELLIPTIC:
        return 0.0
    if r < w.equalities + w.frictions:
        loss = at(rows.frictionloss[w.id], r)
        return friction_cost(loss, loss / stiffness, stiffness, jar)
    if jar < 0.0:
        return 0.5 * stiffness * jar * jar
    return 0.0


@wp.func
def cost_along(rows: Rows, scratch: Scratch, w: World, smooth: wp.vec2, alpha: float) -> wp.vec3:
    """Cost at α minus cost at 0, and its first and second derivative."""
    total = wp.vec3(0.0)
    for r in range(w.equalities + w.lane, w.rows, lane_count()):
        total += row_along(rows, scratch, w, r, alpha)
    for contact in range(w.lane, w.contacts, lane_count()):
        total += cone_along(kept_cone(scratch.cones[w.id], contact), alpha)
    bent = alpha * smooth[1]
    return lane_sums(total) + wp.vec3(alpha * (smooth[0] + 0.5 * bent), smooth[0] + bent, smooth[1])


@wp.func
def open_rows(rows: Rows, scratch: Scratch, w: World) -> wp.vec2:
    """J s of every row; and what equalities add to slope and curvature at α = 0."""
    jacobian = rows.jacobian[w.id]
    direction = scratch.direction[w.id]
    smooth = wp.vec2(0.0)
    for r in range(w.lane, w.rows, lane_count()):
        rate = float(0.0)
        for k in range(0, w.width, 4):
            rate += wp.dot(four(jacobian, r * rows.stride + k), four(direction, k))
        put(scratch.rate[w.id], r, rate)
        if r < w.equalities:
            pull = at(rows.D[w.id], r) * rate
            smooth += wp.vec2(pull * at(scratch.jar[w.id], r), pull * rate)
    return smooth


@wp.func
def search_line(
    rows: Rows, scratch: Scratch, tau: wp.array[float], w: World, least: float, limit: int
) -> tuple[float, float, bool]:
    """Newton's method for the zero of the cost's slope; bisects the bracket when a step does not halve the slope.

    Args:
        tau: the smooth force.
        least: slope below which a point counts as the minimum; raised to the rounding of the slope.
        limit: largest number of evaluations.

    Returns:
        α, the decrease of the cost, and whether it converged within the limit.
    """
    # The quadratic part: inertia and equalities.
    smooth = open_rows(rows, scratch, w)
    for i in range(w.lane, w.nv, lane_count()):
        s = at(scratch.direction[w.id], i)
        smooth += wp.vec2(s * (at(scratch.inertial[w.id], i) - at(tau, i)), s * at(scratch.moved[w.id], i))
    lane_sync()
    smooth = wp.vec2(lane_sum(smooth[0]), lane_sum(smooth[1]))
    start = wp.vec3(0.0)
    cost = float(0.0)
    for r in range(w.equalities + w.lane, w.rows, lane_count()):
        start += row_along(rows, scratch, w, r, 0.0)
        cost += row_cost(rows, scratch, w, r)
    for contact in range(w.lane, w.contacts, lane_count()):
        cone = open_cone(scratch, w.id, contact, rows.D[w.id])
        keep_cone(scratch.cones[w.id], contact, cone)
        start += cone_along(cone, 0.0)
        cost += cost_at_start(cone)
    start = lane_sums(start)
    cost = lane_sum(cost)
    slope = start[1] + smooth[0]
    curvature = start[2] + smooth[1]
    # By Cauchy-Schwarz, |Σ D jar rate| <= √(2 cost curvature): the magnitude of the slope's terms.
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
        point = cost_along(rows, scratch, w, smooth, alpha)
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
