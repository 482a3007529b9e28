"""Elliptic friction cones: their forces, what they add to the Hessian, and their cost along a line.

Their law, with the meaning of N, T, u and m, is in `cone_law`.
"""

import warp as wp

from msk_ray.step.forward.cone_law import QUADRATIC, SATISFIED, SLIDING, cone_mass, zone
from msk_ray.step.forward.fused.lanes import at, lane_count, put, put_whole, whole
from msk_ray.step.forward.fused.scratch import CONE, Scratch

wp.set_module_options({"enable_backward": False})


@wp.struct
class Cone:
    """A contact on the line a + α s."""

    normal: float
    """N at α = 0."""
    normal_rate: float
    """dN/dα."""
    along: float
    """Component of u along the direction of its change, at α = 0."""
    along_rate: float
    """|du/dα|."""
    across: float
    """Square of the constant component of u."""
    mu: float
    mass: float
    """m."""
    cost: float
    """½ Σ D jar² of all rows at α = 0."""
    slope: float
    """Its derivative there."""
    half_curvature: float
    """Half of its second derivative."""


@wp.func
def update_contact(
    scratch: Scratch, world: int, contact: int, stiffness: wp.array[float], force: wp.array[float], state: wp.array[int]
) -> bool:
    """Compute forces, states and weights of a contact's rows, in one lane; returns whether its part of the Hessian may
    have changed."""
    jar = scratch.jar[world]
    bound = scratch.bound[world]
    weight = scratch.weight[world]
    first = whole(scratch.first[world], contact)
    end = whole(scratch.end[world], contact)
    mu = at(bound, first)
    normal = mu * at(jar, first)
    squares = float(0.0)
    for p in range(first + 1, end):
        u = at(bound, p) * at(jar, p)
        squares += u * u
    tangent = wp.sqrt(squares)
    before = whole(state, first)
    now = zone(normal, tangent, mu)
    if now != SLIDING:
        for p in range(first, end):
            counts = wp.where(now == QUADRATIC, at(stiffness, p), 0.0)
            put(weight, p, counts)
            put(force, p, -counts * at(jar, p))
            put_whole(state, p, now)
        # Restore rows that were replaced while sliding.
        put(scratch.leaning[world], contact, wp.where(before == SLIDING, -1.0, 0.0))
        return now != before
    mass = cone_mass(at(stiffness, first), mu)
    inverse = 1.0 / tangent
    pull = mass * mu * (normal - mu * tangent)
    weights = lean_weights(mass, mu, normal, inverse)
    put(weight, first, weights[0])
    put(force, first, -pull)
    put_whole(state, first, SLIDING)
    for p in range(first + 1, end):
        friction = at(bound, p)
        put(weight, p, weights[1])
        put(force, p, pull * inverse * friction * friction * at(jar, p))
        put_whole(state, p, SLIDING)
    put(scratch.leaning[world], contact, inverse)
    return True


@wp.func
def lean_weights(mass: float, mu: float, normal: float, inverse: float) -> wp.vec2:
    """Weights of a sliding contact's rows in `lean_rows`: of the first, and of each other."""
    return wp.vec2(mass * mu * mu, mass * (mu * mu - mu * normal * inverse))


@wp.func
def lean_rows(
    first: int,
    end: int,
    inverse: float,
    jar: wp.array[float],
    bound: wp.array[float],
    jacobian: wp.array[float],
    stride: int,
    columns: int,
    lane: int,
    rows: wp.array[float],
) -> None:
    """Compute the rows of a contact that add to the Hessian, with all lanes; they lie `stride` apart, as in J.

    While it slides, with 1 / T as `inverse`, its part of the Hessian is, with zᵢ = φᵢ Jᵢ, the direction û = u / T and
    p = Σ ûᵢ zᵢ, m μ² (J₀ - p)(J₀ - p)ᵀ + m (μ² - μ N / T) Σ (zᵢ - ûᵢ p)(zᵢ - ûᵢ p)ᵀ: rows with non-negative weights.
    Otherwise they are the rows of J, and `inverse` is not positive.
    """
    for i in range(lane, columns, lane_count()):
        mean = float(0.0)
        if inverse > 0.0:
            for p in range(first + 1, end):
                friction = at(bound, p)
                mean += friction * friction * at(jar, p) * inverse * at(jacobian, p * stride + i)
        put(rows, first * stride + i, at(jacobian, first * stride + i) - mean)
        for p in range(first + 1, end):
            scale = wp.where(inverse > 0.0, at(bound, p), 1.0)
            put(rows, p * stride + i, scale * (at(jacobian, p * stride + i) - at(jar, p) * inverse * mean))


@wp.func
def open_cone(scratch: Scratch, world: int, contact: int, stiffness: wp.array[float]) -> Cone:
    """Coefficients of the contact along the current direction."""
    jar = scratch.jar[world]
    rate = scratch.rate[world]
    bound = scratch.bound[world]
    first = whole(scratch.first[world], contact)
    end = whole(scratch.end[world], contact)
    d = at(stiffness, first)
    x = at(jar, first)
    y = at(rate, first)
    c = Cone()
    c.mu = at(bound, first)
    c.normal = c.mu * x
    c.normal_rate = c.mu * y
    c.mass = cone_mass(d, c.mu)
    cost = d * x * x
    slope = d * x * y
    curvature = d * y * y
    uu = float(0.0)
    uv = float(0.0)
    vv = float(0.0)
    for p in range(first + 1, end):
        d = at(stiffness, p)
        x = at(jar, p)
        y = at(rate, p)
        cost += d * x * x
        slope += d * x * y
        curvature += d * y * y
        u = at(bound, p) * x
        v = at(bound, p) * y
        uu += u * u
        uv += u * v
        vv += v * v
    c.cost = 0.5 * cost
    c.slope = slope
    c.half_curvature = 0.5 * curvature
    c.across = uu
    if vv > 0.0:
        c.along_rate = wp.sqrt(vv)
        c.along = uv / c.along_rate
        # |u|² - along² by Lagrange's identity, because the difference of two large numbers would be rounding noise.
        squares = float(0.0)
        for p in range(first + 2, end):
            u = at(bound, p) * at(jar, p)
            v = at(bound, p) * at(rate, p)
            for q in range(first + 1, p):
                cross = at(bound, q) * (at(rate, q) * u - at(jar, q) * v)
                squares += cross * cross
        c.across = squares / vv
    return c


@wp.func
def keep_cone(cones: wp.array[float], contact: int, c: Cone) -> None:
    k = contact * CONE
    put(cones, k, c.normal)
    put(cones, k + 1, c.normal_rate)
    put(cones, k + 2, c.along)
    put(cones, k + 3, c.along_rate)
    put(cones, k + 4, c.across)
    put(cones, k + 5, c.mu)
    put(cones, k + 6, c.mass)
    put(cones, k + 7, c.cost)
    put(cones, k + 8, c.slope)
    put(cones, k + 9, c.half_curvature)


@wp.func
def kept_cone(cones: wp.array[float], contact: int) -> Cone:
    k = contact * CONE
    c = Cone()
    c.normal = at(cones, k)
    c.normal_rate = at(cones, k + 1)
    c.along = at(cones, k + 2)
    c.along_rate = at(cones, k + 3)
    c.across = at(cones, k + 4)
    c.mu = at(cones, k + 5)
    c.mass = at(cones, k + 6)
    c.cost = at(cones, k + 7)
    c.slope = at(cones, k + 8)
    c.half_curvature = at(cones, k + 9)
    return c


@wp.func
def cost_at_start(c: Cone) -> float:
    """Cost at α = 0."""
    tangent = wp.sqrt(c.along * c.along + c.across)
    state = zone(c.normal, tangent, c.mu)
    if state == SATISFIED:
        return 0.0
    if state == QUADRATIC:
        return c.cost
    gap = c.normal - c.mu * tangent
    return 0.5 * c.mass * gap * gap


@wp.func
def cone_along(c: Cone, alpha: float) -> wp.vec3:
    """Cost at α minus cost at 0, without subtracting large numbers; with its first and second derivative."""
    tangent0 = wp.sqrt(c.along * c.along + c.across)
    state0 = zone(c.normal, tangent0, c.mu)
    gap0 = c.normal - c.mu * tangent0
    normal = c.normal + alpha * c.normal_rate
    along = c.along + alpha * c.along_rate
    squares = along * along + c.across
    tangent = wp.sqrt(squares)
    state = zone(normal, tangent, c.mu)
    if state == SATISFIED:
        cost = float(0.0)
        if state0 == QUADRATIC:
            cost = -c.cost
        if state0 == SLIDING:
            cost = -0.5 * c.mass * gap0 * gap0
        return wp.vec3(cost, 0.0, 0.0)
    springs = alpha * (c.slope + alpha * c.half_curvature)
    if state == QUADRATIC:
        # All rows as springs cost ½ m (1 + μ²)(N² + T²), which is ½ m (μ N + T)² more than sliding.
        cost = springs
        if state0 == SATISFIED:
            cost = 0.5 * c.mass * (1.0 + c.mu * c.mu) * (normal * normal + squares)
        if state0 == SLIDING:
            excess = c.mu * c.normal + tangent0
            cost = springs + 0.5 * c.mass * excess * excess
        return wp.vec3(cost, c.slope + 2.0 * alpha * c.half_curvature, 2.0 * c.half_curvature)
    gap = normal - c.mu * tangent
    cost = 0.5 * c.mass * gap * gap
    if state0 == QUADRATIC:
        excess = c.mu * normal + tangent
        cost = springs - 0.5 * c.mass * excess * excess
    if state0 == SLIDING:
        longer = alpha * c.along_rate * (c.along + along) / (tangent + tangent0)
        more = alpha * c.normal_rate - c.mu * longer
        cost = 0.5 * c.mass * more * (2.0 * gap0 + more)
    inverse = 1.0 / tangent
    gap_rate = c.normal_rate - c.mu * along * c.along_rate * inverse
    bend = c.across / squares * c.along_rate * c.along_rate * inverse
    return wp.vec3(cost, c.mass * gap * gap_rate, c.mass * (gap_rate * gap_rate - c.mu * gap * bend))
