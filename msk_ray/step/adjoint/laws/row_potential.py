"""The work of one uncoupled constraint row, which Warp differentiates by its rates, solver parameters, bound and h.

`scalar_rows` calls it in its kernel; here is the formula only.

-Φ ∋ ρ(λ) f(jar) ,  jar = ρ(a) + b ρ(v) + k imp pos ,  f = -D jar, or ± the friction loss where it is held at that
"""

import warp as wp

from msk_ray.step.adjoint.laws.impedance import impedance, stiffness_damping
from msk_ray.step.forward.mjw_private import vec5

wp.set_module_options({"enable_backward": False})


@wp.struct
class RowMotion:
    """A row's rates under λ and v, what else its force is made of, and the scale of D."""

    lam: wp.float32
    vel: wp.float32
    rest: wp.float32
    """jar without what the solver parameters give it: ρ(a)."""
    weight: wp.float32
    """1/D without its impedance."""
    held: wp.float32
    """Sign of the force of a friction loss at its bound, else 0."""
    disableflags: wp.int32


@wp.func
def row_potential(
    motion: RowMotion, solref: wp.vec2, solimp: vec5, pos: wp.float32, loss: wp.float32, timestep: wp.float32
) -> wp.float32:
    """-Φ ∋ ρ(λ) f(ρ(a) + b ρ(v) + k imp pos) of one row that pushes."""
    kb = stiffness_damping(motion.disableflags, timestep, solref, solimp[1])
    imp = impedance(solimp, pos)
    mass = imp / ((1.0 - imp) * motion.weight)
    force = -mass * (motion.rest + kb[1] * motion.vel + kb[0] * imp * pos)
    if motion.held != 0.0:
        force = motion.held * loss
    return motion.lam * force
