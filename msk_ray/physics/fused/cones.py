"""Elliptic friction cones: their forces, what they add to the Hessian, and their cost along a line.

With N = μ jar₀ and uᵢ = φᵢ jarᵢ, T = |u|, the cone is circular. Its dual is satisfied where N >= μ T; where
μ N + T <= 0 all rows are springs; between, the contact slides and costs ½ m (N - μ T)², m = D₀ / (μ² (1 + μ²)).
"""

import warp as wp

from msk_ray.physics import mjw_private as private
from msk_ray.physics.fused.memory import four, put_four, put_number, put_whole, whole
from msk_ray.physics.fused.scratch import CONE, Scratch

wp.set_module_options({"enable_backward": False})

SATISFIED = wp.constant(int(private.ConstraintState.SATISFIED))
QUADRATIC = wp.constant(int(private.ConstraintState.QUADRATIC))
SLIDING = wp.constant(int(private.ConstraintState.CONE))


@wp.struct
class Cone:
    """A contact on the line a + α s."""

    normal: float
    """N at α = 0."""
    normal_rate: float
    """dN/dα."""
    along: float
    """Part of u in the direction in which it changes, at α = 0."""
    along_rate: float
    """|du/dα|."""
    across: float
    """Square of the other part of u, which does not change."""
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
def zone(normal: float, tangent: float, mu: float) -> int:
    """State of a contact with these N and T."""
    if normal >= mu * tangent:
        return SATISFIED
    if mu * normal + tangent <= 0.0:
        return QUADRATIC
    return SLIDING


@wp.func
def cone_mass(stiffness: float, mu: float) -> float:
    return stiffness / (mu * mu * (1.0 + mu * mu))


@wp.func
def update_contact(scratch: Scratch, world: int, blocks: int, room: int, contact: int) -> bool:
    """Forces, states and weights of a contact's rows; whether its part of the Hessian may have changed.

    While it slides, its part of the Hessian is, with zᵢ = φᵢ Jᵢ, the direction û = u / T and p = Σ ûᵢ zᵢ,
    m μ² (J₀ - p)(J₀ - p)ᵀ + m (μ² - μ N / T) Σ (zᵢ - ûᵢ p)(zᵢ - ûᵢ p)ᵀ: rows with weights that are not negative. Behind
    the rows of J are these, or J itself while all are springs.
    """
    first = whole(scratch.first, world, contact)
    end = whole(scratch.first, world, contact + 1)
    head = four(scratch.springs, world, first)
    mu = head[1]
    normal = mu * head[2]
    squares = float(0.0)
    for p in range(first + 1, end):
        row = four(scratch.springs, world, p)
        u = row[1] * row[2]
        squares += u * u
    tangent = wp.sqrt(squares)
    before = whole(scratch.state, world, first)
    state = zone(normal, tangent, mu)
    behind = room * blocks
    if state != SLIDING:
        for p in range(first, end):
            row = four(scratch.springs, world, p)
            weight = wp.where(state == QUADRATIC, row[0], 0.0)
            put_number(scratch.force, world, p, -weight * row[2])
            put_number(scratch.weight, world, p, weight)
            put_whole(scratch.state, world, p, state)
        if state == QUADRATIC and before == SLIDING:
            for at in range(first * blocks, end * blocks):
                put_four(scratch.rows, world, behind + at, four(scratch.rows, world, at))
        return state != before
    mass = cone_mass(head[0], mu)
    inverse = 1.0 / tangent
    pull = mass * mu * (normal - mu * tangent)
    turning = mass * (mu * mu - mu * normal * inverse)
    put_number(scratch.force, world, first, -pull)
    put_number(scratch.weight, world, first, mass * mu * mu)
    put_whole(scratch.state, world, first, SLIDING)
    for p in range(first + 1, end):
        row = four(scratch.springs, world, p)
        put_number(scratch.force, world, p, pull * inverse * row[1] * row[1] * row[2])
        put_number(scratch.weight, world, p, turning)
        put_whole(scratch.state, world, p, SLIDING)
    for k in range(blocks):
        mean = wp.vec4(0.0)
        for p in range(first + 1, end):
            row = four(scratch.springs, world, p)
            mean += row[1] * row[1] * row[2] * inverse * four(scratch.rows, world, p * blocks + k)
        at = first * blocks + k
        put_four(scratch.rows, world, behind + at, four(scratch.rows, world, at) - mean)
        for p in range(first + 1, end):
            row = four(scratch.springs, world, p)
            at = p * blocks + k
            turned = row[1] * (four(scratch.rows, world, at) - row[2] * inverse * mean)
            put_four(scratch.rows, world, behind + at, turned)
    return True


@wp.func
def open_cone(scratch: Scratch, world: int, contact: int) -> Cone:
    """The contact on the line along the present direction."""
    first = whole(scratch.first, world, contact)
    end = whole(scratch.first, world, contact + 1)
    head = four(scratch.springs, world, first)
    c = Cone()
    c.mu = head[1]
    c.normal = head[1] * head[2]
    c.normal_rate = head[1] * head[3]
    c.mass = cone_mass(head[0], head[1])
    cost = head[0] * head[2] * head[2]
    slope = head[0] * head[2] * head[3]
    curvature = head[0] * head[3] * head[3]
    uu = float(0.0)
    uv = float(0.0)
    vv = float(0.0)
    for p in range(first + 1, end):
        row = four(scratch.springs, world, p)
        cost += row[0] * row[2] * row[2]
        slope += row[0] * row[2] * row[3]
        curvature += row[0] * row[3] * row[3]
        u = row[1] * row[2]
        v = row[1] * row[3]
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
        # |u|² - along² by Lagrange's identity: the difference of two large numbers would be noise.
        squares = float(0.0)
        for p in range(first + 2, end):
            row = four(scratch.springs, world, p)
            u = row[1] * row[2]
            v = row[1] * row[3]
            for q in range(first + 1, p):
                other = four(scratch.springs, world, q)
                cross = other[1] * (other[3] * u - other[2] * v)
                squares += cross * cross
        c.across = squares / vv
    return c


@wp.func
def keep_cone(scratch: Scratch, world: int, contact: int, c: Cone) -> None:
    k = contact * CONE
    put_four(scratch.cones, world, k, wp.vec4(c.normal, c.normal_rate, c.along, c.along_rate))
    put_four(scratch.cones, world, k + 1, wp.vec4(c.across, c.mu, c.mass, c.cost))
    put_four(scratch.cones, world, k + 2, wp.vec4(c.slope, c.half_curvature, 0.0, 0.0))


@wp.func
def kept_cone(scratch: Scratch, world: int, contact: int) -> Cone:
    k = contact * CONE
    motion = four(scratch.cones, world, k)
    law = four(scratch.cones, world, k + 1)
    springs = four(scratch.cones, world, k + 2)
    c = Cone()
    c.normal = motion[0]
    c.normal_rate = motion[1]
    c.along = motion[2]
    c.along_rate = motion[3]
    c.across = law[0]
    c.mu = law[1]
    c.mass = law[2]
    c.cost = law[3]
    c.slope = springs[0]
    c.half_curvature = springs[1]
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
    """Cost at α less that at 0, without taking the difference of two large numbers; its first and second derivative."""
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
        # All springs together cost ½ m (1 + μ²)(N² + T²), which is ½ m (μ N + T)² more than sliding does.
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
