"""Gradients of the material of contacts, given to their pair or mixed back to their two geoms.

Where two geoms have the same friction, mujoco_warp takes the larger of equal values: each gets half of the gradient,
the mean of both one-sided slopes.
"""

from typing import Any

import numpy as np
import warp as wp

from msk_ray.step.adjoint.groups import Contacts, Fields, Motion, RowLaws, Rows, Shapes, Substep, TimestepGradient
from msk_ray.step.adjoint.laws.contacts import components, relative_rates, row_count
from msk_ray.step.adjoint.laws.impedance import impedance, stiffness_damping
from msk_ray.step.adjoint.parameters.base import ParameterFamily
from msk_ray.step.adjoint.parameters.contact_laws import ContactMotion, contact_potential, pyramid_weight
from msk_ray.step.adjoint.step import StepAdjoint
from msk_ray.step.forward.mjw_private import ConstraintType, vec5

wp.set_module_options({"enable_backward": False})

_MINMU = wp.constant(1.0e-5)
_MINVAL = wp.constant(1.0e-15)


@wp.struct
class MaterialGradients:
    """Gradients by geom (W, G) and by listed pair (W, P)."""

    geom_friction: wp.array2d[wp.vec3]
    geom_solref: wp.array2d[wp.vec2]
    geom_solimp: wp.array2d[vec5]
    pair_friction: wp.array2d[vec5]
    pair_solref: wp.array2d[wp.vec2]
    pair_solreffriction: wp.array2d[wp.vec2]
    pair_solimp: wp.array2d[vec5]


@wp.struct
class Materials:
    """What decides how two geoms mix."""

    geom_priority: wp.array[int]
    geom_solmix: wp.array2d[float]
    geom_friction: wp.array2d[wp.vec3]
    geom_solref: wp.array2d[wp.vec2]
    pair_friction: wp.array2d[vec5]


@wp.func
def share_of_larger(own: float, other: float) -> float:
    """Slope of max(own, other) by `own`, ½ where they are equal."""
    if own == other:
        return 0.5
    return wp.where(own > other, 1.0, 0.0)


@wp.func
def solver_mix(materials: Materials, worldid: int, geom1: int, geom2: int) -> float:
    """Weight of the first geom's solver parameters, as mujoco_warp mixes them."""
    if materials.geom_priority[geom1] != materials.geom_priority[geom2]:
        return wp.where(materials.geom_priority[geom1] > materials.geom_priority[geom2], 1.0, 0.0)
    mix1 = materials.geom_solmix[worldid % materials.geom_solmix.shape[0], geom1]
    mix2 = materials.geom_solmix[worldid % materials.geom_solmix.shape[0], geom2]
    if mix1 < _MINVAL and mix2 < _MINVAL:
        return 0.5
    if mix1 < _MINVAL:
        return 0.0
    if mix2 < _MINVAL:
        return 1.0
    return mix1 / (mix1 + mix2)


@wp.func
def pull_mix(
    worldid: int,
    geom: int,
    other: int,
    mix: float,
    materials: Materials,
    friction_bar: vec5,
    solref_bar: wp.vec2,
    solimp_bar: vec5,
    gradients_out: MaterialGradients,
) -> None:
    """Adds one geom's share of a contact's gradients."""
    row = worldid % materials.geom_friction.shape[0]
    own = materials.geom_friction[row, geom]
    total = wp.vec3(friction_bar[0] + friction_bar[1], friction_bar[2], friction_bar[3] + friction_bar[4])
    for k in range(3):
        share = float(0.0)
        if materials.geom_priority[geom] > materials.geom_priority[other]:
            share = 1.0
        elif materials.geom_priority[geom] == materials.geom_priority[other]:
            share = share_of_larger(own[k], materials.geom_friction[row, other][k])
        # mujoco_warp holds friction above its floor
        if own[k] <= _MINMU:
            share = 0.0
        total[k] = share * total[k]
    wp.atomic_add(gradients_out.geom_friction, worldid, geom, total)
    row = worldid % materials.geom_solref.shape[0]
    ref = materials.geom_solref[row, geom]
    ref_other = materials.geom_solref[row, other]
    weight = wp.vec2(mix, mix)
    if ref[0] <= 0.0 or ref_other[0] <= 0.0:
        # in the direct format the smaller value counts
        weight = wp.vec2(share_of_larger(-ref[0], -ref_other[0]), share_of_larger(-ref[1], -ref_other[1]))
    wp.atomic_add(gradients_out.geom_solref, worldid, geom, wp.cw_mul(weight, solref_bar))
    wp.atomic_add(gradients_out.geom_solimp, worldid, geom, mix * solimp_bar)


@wp.kernel
def pull_materials(
    # Model:
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    opt_impratio_invsqrt: wp.array[float],
    shapes: Shapes,
    materials: Materials,
    pair_of: wp.array2d[int],
    # In:
    live_in: wp.array[int],
    nacon_in: wp.array[int],
    rows_in: Rows,
    laws_in: RowLaws,
    contacts_in: Contacts,
    motion_in: Motion,
    fields_in: Fields,
    # Out:
    gradients_out: MaterialGradients,
    timestep_out: TimestepGradient,
) -> None:
    """-Φ ∋ Σ_r ρ_r(λ) f_r: gradients of one contact's material, and of the time step that bounds its stiffness."""
    con = wp.tid()
    if con >= wp.min(nacon_in[0], contacts_in.dist.shape[0]):
        return
    first = contacts_in.efc_address[con, 0]
    worldid = contacts_in.worldid[con]
    if first < 0 or live_in[worldid] == 0:
        return
    motion = ContactMotion()
    motion.dim = contacts_in.dim[con]
    motion.elliptic = int(rows_in.type[worldid, first] == ConstraintType.CONTACT_ELLIPTIC)
    count = row_count(motion.dim, motion.elliptic == 1)
    if contacts_in.efc_address[con, count - 1] < 0:
        return
    active = bool(False)
    for i in range(count):
        active = active or laws_in.jar[worldid, first + i] < 0.0
    if motion.elliptic == 0 and not active:
        return

    geoms = contacts_in.geom[con]
    body1 = shapes.geom_bodyid[geoms[0]]
    body2 = shapes.geom_bodyid[geoms[1]]
    frame = contacts_in.frame[con]
    arm1 = contacts_in.pos[con] - motion_in.subtree_com[worldid, shapes.body_rootid[body1]]
    arm2 = contacts_in.pos[con] - motion_in.subtree_com[worldid, shapes.body_rootid[body2]]
    rates = relative_rates(worldid, body1, body2, arm1, arm2, motion_in, fields_in)
    motion.lam = components(frame, rates.lam_slide, rates.lam_spin, motion.dim)
    motion.acc = components(frame, rates.acc_slide, rates.acc_spin, motion.dim)
    motion.vel = components(frame, rates.vel_slide, rates.vel_spin, motion.dim)
    motion.pos = contacts_in.dist[con] - contacts_in.includemargin[con]
    motion.disableflags = opt_disableflags
    motion.impratio_invsqrt = opt_impratio_invsqrt[worldid % opt_impratio_invsqrt.shape[0]]
    friction = contacts_in.friction[con]
    solref = contacts_in.solref[con]
    solimp = contacts_in.solimp[con]
    timestep = opt_timestep[worldid % opt_timestep.shape[0]]
    kb = stiffness_damping(opt_disableflags, timestep, solref, solimp[1])
    imp = impedance(solimp, motion.pos)
    side_damping = kb[1]
    sideways = contacts_in.solreffriction[con]
    if sideways[0] != 0.0 or sideways[1] != 0.0:
        side_damping = stiffness_damping(opt_disableflags, timestep, sideways, solimp[1])[1]
    normal = motion.acc[0] + kb[1] * motion.vel[0] + kb[0] * imp * motion.pos
    for i in range(count):
        jar = normal
        if motion.elliptic == 1 and i > 0:
            jar = motion.acc[i] + side_damping * motion.vel[i]
        elif motion.elliptic == 0 and motion.dim > 1:
            k = i / 2 + 1
            jar += friction[k - 1] * wp.where(i % 2 == 0, 1.0, -1.0) * (motion.acc[k] + kb[1] * motion.vel[k])
        motion.offset[i] = laws_in.jar[worldid, first + i] - jar
    motion.weight = imp / ((1.0 - imp) * rows_in.D[worldid, first])
    if motion.elliptic == 0 and motion.dim > 1:
        motion.weight = motion.weight / pyramid_weight(friction[0])
    _m, friction_bar, solref_bar, side_bar, solimp_bar, timestep_bar = wp.grad(contact_potential)(
        motion, friction, solref, contacts_in.solreffriction[con], solimp, timestep
    )
    wp.atomic_add(timestep_out.timestep, worldid, timestep_bar)
    pair = pair_of[geoms[0], geoms[1]]
    if pair >= 0:
        row = worldid % materials.pair_friction.shape[0]
        for k in range(5):
            if materials.pair_friction[row, pair][k] <= _MINMU:
                friction_bar[k] = 0.0
        wp.atomic_add(gradients_out.pair_friction, worldid, pair, friction_bar)
        wp.atomic_add(gradients_out.pair_solref, worldid, pair, solref_bar)
        wp.atomic_add(gradients_out.pair_solreffriction, worldid, pair, side_bar)
        wp.atomic_add(gradients_out.pair_solimp, worldid, pair, solimp_bar)
        return
    mix = solver_mix(materials, worldid, geoms[0], geoms[1])
    pull_mix(worldid, geoms[0], geoms[1], mix, materials, friction_bar, solref_bar, solimp_bar, gradients_out)
    pull_mix(worldid, geoms[1], geoms[0], 1.0 - mix, materials, friction_bar, solref_bar, solimp_bar, gradients_out)


class MaterialFamily(ParameterFamily):
    """Launches of the gradients of friction, solref and solimp of contacts."""

    kinds = (MaterialGradients, TimestepGradient)

    def __init__(self, adjoint: StepAdjoint, gradients: dict[Any, Any]) -> None:
        super().__init__(adjoint, gradients)
        mjm = adjoint.work.mjm
        pairs = np.full((max(mjm.ngeom, 1),) * 2, -1, dtype=np.int32)
        pairs[mjm.pair_geom1, mjm.pair_geom2] = pairs[mjm.pair_geom2, mjm.pair_geom1] = np.arange(mjm.npair)
        self._pair_of = wp.array(pairs, dtype=int)

    def launch(self, at: Substep) -> None:
        self.work.launch(pull_materials, self.adjoint.contacts.count, at, *self.gradients, pair_of=self._pair_of)
