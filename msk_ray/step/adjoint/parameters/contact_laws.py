"""Friction, solref and solimp of contacts: how the rows of one contact answer to them.

`contact_potential` is what a contact gives -Φ, Σ_r ρ_r(λ) f_r(ρ(a) - aref), as a function of its material alone. The
law of an elliptic contact is in `forward.cone_law`.
"""

import warp as wp

from msk_ray.step.adjoint.laws.cones import vec6
from msk_ray.step.adjoint.laws.impedance import impedance, stiffness_damping
from msk_ray.step.forward.cone_law import QUADRATIC, SLIDING, cone_mass, zone
from msk_ray.step.forward.mjw_private import vec5, vec10

wp.set_module_options({"enable_backward": False})


@wp.struct
class ContactMotion:
    """What stays fixed in the potential: rates under λ, a and v, the position, and the scale of D."""

    lam: vec6
    acc: vec6
    vel: vec6
    offset: vec10
    """What the adjoint's own J a - aref of each row is beyond that of these rates: their rounding."""
    pos: wp.float32
    """dist - margin."""
    weight: wp.float32
    """1/D of the normal row without its impedance and friction."""
    impratio_invsqrt: wp.float32
    dim: wp.int32
    elliptic: wp.int32
    disableflags: wp.int32


@wp.func
def pyramid_weight(friction: wp.float32) -> wp.float32:
    """Share of 1/D that a pyramid's friction makes: 2 μ² (1 + μ²)."""
    square = friction * friction
    return 2.0 * square * (1.0 + square)


@wp.func
def edge_potential(
    motion: ContactMotion,
    stiffness: wp.float32,
    damping: wp.float32,
    mass: wp.float32,
    lean: wp.float32,
    k: wp.int32,
    row: wp.int32,
) -> wp.float32:
    """One row of a pyramid, ρ = ρ₀ + lean ρ_k, or with k = 0 that of a frictionless contact."""
    lam = motion.lam[0]
    jar = motion.acc[0] + damping * motion.vel[0] + stiffness * motion.pos + motion.offset[row]
    if k > 0:
        lam += lean * motion.lam[k]
        jar += lean * (motion.acc[k] + damping * motion.vel[k])
    potential = wp.float32(0.0)
    if jar < 0.0:
        potential = -lam * mass * jar
    return potential


@wp.func
def cone_potential(
    motion: ContactMotion,
    friction: vec5,
    stiffness: wp.float32,
    damping: wp.float32,
    side_damping: wp.float32,
    mass: wp.float32,
) -> wp.float32:
    """All rows of an elliptic contact."""
    mu = friction[0] * motion.impratio_invsqrt
    jar0 = motion.acc[0] + damping * motion.vel[0] + stiffness * motion.pos + motion.offset[0]
    square = wp.float32(0.0)
    across = wp.float32(0.0)
    stuck = wp.float32(0.0)
    for i in range(1, 6):
        if i < motion.dim:
            phi = friction[i - 1]
            jar = motion.acc[i] + side_damping * motion.vel[i] + motion.offset[i]
            square += phi * phi * jar * jar
            across += motion.lam[i] * phi * phi * jar
            # D_i = D₀ (φᵢ / μ)²
            stuck += motion.lam[i] * phi * phi * jar / (mu * mu)
    side = wp.float32(0.0)
    if square > 0.0:  # at 0 the root has no slope
        side = wp.sqrt(square)
    normal = mu * jar0
    now = zone(normal, side, mu)
    potential = wp.float32(0.0)
    if now == QUADRATIC:
        potential = -mass * (motion.lam[0] * jar0 + stuck)
    elif now == SLIDING:
        push = cone_mass(mass, mu) * mu * (mu * side - normal)
        potential = push * (motion.lam[0] - across / side)
    return potential


@wp.func
def contact_potential(
    motion: ContactMotion,
    friction: vec5,
    solref: wp.vec2,
    solreffriction: wp.vec2,
    solimp: vec5,
    timestep: wp.float32,
) -> wp.float32:
    """Σ_r ρ_r(λ) f_r of one contact."""
    kb = stiffness_damping(motion.disableflags, timestep, solref, solimp[1])
    imp = impedance(solimp, motion.pos)
    stiffness = kb[0] * imp
    mass = imp / ((1.0 - imp) * motion.weight)
    potential = wp.float32(0.0)
    if motion.elliptic == 1:
        side_damping = kb[1]
        if solreffriction[0] != 0.0 or solreffriction[1] != 0.0:
            side = stiffness_damping(motion.disableflags, timestep, solreffriction, solimp[1])
            side_damping = side[1]
        potential = cone_potential(motion, friction, stiffness, kb[1], side_damping, mass)
    elif motion.dim == 1:
        potential = edge_potential(motion, stiffness, kb[1], mass, 0.0, 0, 0)
    else:
        share = mass / pyramid_weight(friction[0])
        for k in range(1, 6):
            if k < motion.dim:
                potential += edge_potential(motion, stiffness, kb[1], share, friction[k - 1], k, 2 * k - 2)
                potential += edge_potential(motion, stiffness, kb[1], share, -friction[k - 1], k, 2 * k - 1)
    return potential
