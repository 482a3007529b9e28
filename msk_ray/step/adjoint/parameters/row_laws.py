"""The work of one uncoupled constraint row, which Warp differentiates by solver parameters, bound, position and h.

-Φ ∋ ρ(λ) f(jar) ,  jar = ρ(a) + b ρ(v) + k imp pos ,  f = -D jar (limits where jar < 0, friction loss clamped)
"""

import warp as wp

from msk_ray.step.adjoint.laws.impedance import impedance, stiffness_damping
from msk_ray.step.forward.mjw_private import vec5

wp.set_module_options({"enable_backward": False})

FRICTION, ONE_SIDED, TWO_SIDED = (wp.constant(i) for i in range(3))
"""Laws of rows: clamped at the friction loss; limits; equalities."""


@wp.struct
class RowMotion:
    """What stays fixed in the score: rates under λ and v, the rest of jar, and the scale of D."""

    law: wp.int32
    lam: wp.float32
    vel: wp.float32
    rest: wp.float32
    """jar without what the solver parameters give it: ρ(a)."""
    weight: wp.float32
    """1/D without its impedance."""
    disableflags: wp.int32


@wp.func
def row_score(
    motion: RowMotion,
    solref: wp.vec2,
    solimp: vec5,
    pos: wp.float32,
    loss: wp.float32,
    timestep: wp.float32,
) -> wp.float32:
    """-Φ ∋ ρ(λ) f(ρ(a) + b ρ(v) + k imp pos) of one row."""
    kb = stiffness_damping(motion.disableflags, timestep, solref, solimp[1])
    imp = impedance(solimp, pos)
    mass = imp / ((1.0 - imp) * motion.weight)
    jar = motion.rest + kb[1] * motion.vel
    if motion.law != FRICTION:
        jar += kb[0] * imp * pos
    force = -mass * jar
    if motion.law == FRICTION:
        force = wp.clamp(force, -loss, loss)
    elif motion.law == ONE_SIDED and jar > 0.0:
        force = wp.float32(0.0)
    return motion.lam * force
