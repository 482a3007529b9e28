"""Elliptic friction cones: their forces, what they add to the Hessian, and their cost along a line.

With N = μ jar₀ and uᵢ = φᵢ jarᵢ, T = |u|, the cone is circular. Its dual is satisfied where N >= μ T; where
μ N + T <= 0 all rows are springs; between, the contact slides and costs ½ m (N - μ T)², m = D₀ / (μ² (1 + μ²)).
"""

import warp as wp

from msk_ray.physics import mjw_private as private
from msk_ray.physics.fused.blocks import four, put_four
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
def update_contact(scratch: Scratch, world: int, width: int, room: int, contact: int) -> bool:
    """Forces, states and weights of a contact's rows; whether its part of the Hessian may have changed.

    While it slides, its part of the Hessian is, with zᵢ = φᵢ Jᵢ, the direction û = u / T and p = Σ ûᵢ zᵢ,
    m μ² (J₀ - p)(J₀ - p)ᵀ + m (μ² - μ N / T) Σ (zᵢ - ûᵢ p)(zᵢ - ûᵢ p)ᵀ: rows with weights that are not negative.
    """
    first = scratch.first[world, contact]
    end = scratch.first[world, contact + 1]
    mu = scratch.bound[world, first]
    normal = mu * scratch.jar[world, first]
    squares = float(0.0)
    for p in range(first + 1, end):
        u = scratch.bound[world, p] * scratch.jar[world, p]
        squares += u * u
    tangent = wp.sqrt(squares)
    before = scratch.state[world, first]
    state = zone(normal, tangent, mu)
    if state != SLIDING:
        for p in range(first, end):
            weight = wp.where(state == QUADRATIC, scratch.stiffness[world, p], 0.0)
            scratch.force[world, p] = -weight * scratch.jar[world, p]
            scratch.weight[world, p] = weight
            scratch.state[world, p] = state
        return state != before
    mass = cone_mass(scratch.stiffness[world, first], mu)
    inverse = 1.0 / tangent
    pull = mass * mu * (normal - mu * tangent)
    scratch.force[world, first] = -pull
    scratch.weight[world, first] = mass * mu * mu
    scratch.state[world, first] = SLIDING
    turning = mass * (mu * mu - mu * normal * inverse)
    for p in range(first + 1, end):
        scratch.force[world, p] = (
            pull * inverse * scratch.bound[world, p] * scratch.bound[world, p] * scratch.jar[world, p]
        )
        scratch.weight[world, p] = turning
        scratch.state[world, p] = SLIDING
    behind = room * width
    for k in range(0, width, 4):
        mean = wp.vec4(0.0)
        for p in range(first + 1, end):
            friction = scratch.bound[world, p]
            mean += friction * friction * scratch.jar[world, p] * inverse * four(scratch.rows, world, p * width + k)
        at = first * width + k
        put_four(scratch.rows, world, behind + at, four(scratch.rows, world, at) - mean)
        for p in range(first + 1, end):
            friction = scratch.bound[world, p]
            at = p * width + k
            turned = friction * (four(scratch.rows, world, at) - scratch.jar[world, p] * inverse * mean)
            put_four(scratch.rows, world, behind + at, turned)
    return True


@wp.func
def open_cone(scratch: Scratch, world: int, contact: int) -> Cone:
    """The contact on the line along the present direction."""
    first = scratch.first[world, contact]
    end = scratch.first[world, contact + 1]
    c = Cone()
    c.mu = scratch.bound[world, first]
    jar = scratch.jar[world, first]
    rate = scratch.rate[world, first]
    stiffness = scratch.stiffness[world, first]
    c.normal = c.mu * jar
    c.normal_rate = c.mu * rate
    c.mass = cone_mass(stiffness, c.mu)
    cost = stiffness * jar * jar
    slope = stiffness * jar * rate
    curvature = stiffness * rate * rate
    uu = float(0.0)
    uv = float(0.0)
    vv = float(0.0)
    for p in range(first + 1, end):
        jar = scratch.jar[world, p]
        rate = scratch.rate[world, p]
        stiffness = scratch.stiffness[world, p]
        cost += stiffness * jar * jar
        slope += stiffness * jar * rate
        curvature += stiffness * rate * rate
        u = scratch.bound[world, p] * jar
        v = scratch.bound[world, p] * rate
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
            u = scratch.bound[world, p] * scratch.jar[world, p]
            v = scratch.bound[world, p] * scratch.rate[world, p]
            for q in range(first + 1, p):
                cross = scratch.bound[world, q] * (scratch.rate[world, q] * u - scratch.jar[world, q] * v)
                squares += cross * cross
        c.across = squares / vv
    return c


@wp.func
def keep_cone(scratch: Scratch, world: int, contact: int, c: Cone) -> None:
    k = contact * CONE
    scratch.cones[world, k] = c.normal
    scratch.cones[world, k + 1] = c.normal_rate
    scratch.cones[world, k + 2] = c.along
    scratch.cones[world, k + 3] = c.along_rate
    scratch.cones[world, k + 4] = c.across
    scratch.cones[world, k + 5] = c.mu
    scratch.cones[world, k + 6] = c.mass
    scratch.cones[world, k + 7] = c.cost
    scratch.cones[world, k + 8] = c.slope
    scratch.cones[world, k + 9] = c.half_curvature


@wp.func
def kept_cone(scratch: Scratch, world: int, contact: int) -> Cone:
    k = contact * CONE
    c = Cone()
    c.normal = scratch.cones[world, k]
    c.normal_rate = scratch.cones[world, k + 1]
    c.along = scratch.cones[world, k + 2]
    c.along_rate = scratch.cones[world, k + 3]
    c.across = scratch.cones[world, k + 4]
    c.mu = scratch.cones[world, k + 5]
    c.mass = scratch.cones[world, k + 6]
    c.cost = scratch.cones[world, k + 7]
    c.slope = scratch.cones[world, k + 8]
    c.half_curvature = scratch.cones[world, k + 9]
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
