"""Elliptic contacts: their forces f(jar) and the slope S = -∂f/∂jar, from the law in `forward.cone_law`.

Sliding, with g = μ (1, -t), tᵢ = φᵢ² jarᵢ / T and m, p as there:

    S = m g gᵀ + κ (diag(φ²) - t tᵀ over the tangents) ,  κ = μ p / T .

The linear systems need S as a matrix, so it is written out here. `parameters.contact_laws` has the work ρ(λ)·f of the
same forces as a potential, which Warp differentiates by material: only where such gradients are wanted, because
`pull_contacts` would otherwise work out the slopes of the material for every contact.
"""

import warp as wp

from msk_ray.step.forward.cone_law import QUADRATIC, SLIDING, cone_mass, zone
from msk_ray.step.forward.mjw_private import vec5

wp.set_module_options({"enable_backward": False})


class vec6(wp.types.vector(length=6, dtype=wp.float32)):
    """One number per contact dimension: normal, two tangents, torsion, two rolls."""


@wp.struct
class Cone:
    """Elliptic contact law at one jar: f and what S = -∂f/∂jar needs."""

    zone: int
    force: vec6
    tangent: vec6
    """t, zero at the normal."""
    outer: float
    """m."""
    inner: float
    """κ."""
    mu: float


@wp.func
def cone_at(jar: vec6, mass: vec6, friction: vec5, mu: float, dim: int) -> Cone:
    """The law of an elliptic contact at `jar`; `mass` is D of its rows."""
    out = Cone()
    out.mu = mu
    normal = mu * jar[0]
    square = float(0.0)
    for i in range(1, dim):
        u = friction[i - 1] * jar[i]
        square += u * u
    side = wp.sqrt(square)
    out.zone = zone(normal, side, mu)
    if out.zone == QUADRATIC:
        for i in range(dim):
            out.force[i] = -mass[i] * jar[i]
    elif out.zone == SLIDING:
        out.outer = cone_mass(mass[0], mu)
        gap = normal - mu * side
        out.force[0] = -out.outer * gap * mu
        for i in range(1, dim):
            out.tangent[i] = friction[i - 1] * friction[i - 1] * jar[i] / side
            out.force[i] = -out.force[0] * out.tangent[i]
        out.inner = -out.outer * mu * gap / side
    return out


@wp.func
def cone_slope(cone: Cone, mass: vec6, friction: vec5, dim: int, x: vec6) -> vec6:
    """S x. Sliding: m g (g·x) + κ (φ² x - t (t·x))."""
    out = vec6()
    if cone.zone == QUADRATIC:
        for i in range(dim):
            out[i] = mass[i] * x[i]
    elif cone.zone == SLIDING:
        along = float(0.0)
        for i in range(1, dim):
            along += cone.tangent[i] * x[i]
        lead = cone.outer * cone.mu * cone.mu * (x[0] - along)
        out[0] = lead
        for i in range(1, dim):
            phi = friction[i - 1]
            out[i] = -lead * cone.tangent[i] + cone.inner * (phi * phi * x[i] - cone.tangent[i] * along)
    return out
