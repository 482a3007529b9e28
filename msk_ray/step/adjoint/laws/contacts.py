"""Contacts: cotangents of rows to wrenches on two bodies, through the relative twist at the contact point.

A contact's rows are fixed combinations of ρ_k(x), k < condim: the relative velocity at the contact point under a
plain field x, along the frame's axes (k < 3), and the relative spin (k ≥ 3). Φ holds them under x = λ (row
"velocity" of the multiplier), a (J a) and v (aref). The frame, the point and the distance move with both bodies.
"""

import warp as wp

from msk_ray.step.adjoint.coverage.contact_kinds import colliding_pairs
from msk_ray.step.adjoint.groups import (
    ContactBars,
    Contacts,
    FieldBars,
    Fields,
    Motion,
    RowLaws,
    Rows,
    Shapes,
    Substep,
    allocate,
)
from msk_ray.step.adjoint.laws.cones import cone_at, cone_slope, vec6
from msk_ray.step.adjoint.laws.contact_geometry.contact_order import contacts_end
from msk_ray.step.adjoint.laws.contact_geometry.convex import pull_convex
from msk_ray.step.adjoint.laws.contact_geometry.primitive_laws import CONVEX_PAIRS
from msk_ray.step.adjoint.laws.contact_geometry.primitives import PairKinds, pull_geometry_kernel
from msk_ray.step.adjoint.laws.impedance import row_slopes, stiffness_damping
from msk_ray.step.adjoint.spatial import carried, point_velocity, wrench
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.cone_law import SATISFIED
from msk_ray.step.forward.mjw_private import ConstraintType

wp.set_module_options({"enable_backward": False})


@wp.func
def components(frame: wp.mat33, slide: wp.vec3, spin: wp.vec3, dim: int) -> vec6:
    """ρ: the relative velocity along the frame, then the relative spin."""
    out = vec6()
    for k in range(dim):
        if k < 3:
            out[k] = wp.dot(frame[k], slide)
        else:
            out[k] = wp.dot(frame[k - 3], spin)
    return out


@wp.func
def along_frame(frame: wp.mat33, weight: vec6, first: int) -> wp.vec3:
    """Σ weight[first + k] frame[k], k < 3: the cotangent of a velocity whose components have these weights."""
    return weight[first] * frame[0] + weight[first + 1] * frame[1] + weight[first + 2] * frame[2]


@wp.func
def frame_weight(weight: vec6, slide: wp.vec3, spin: wp.vec3) -> wp.mat33:
    """Cotangent of the frame where components with these weights are read off it."""
    out = wp.mat33()
    for k in range(3):
        out[k] = weight[k] * slide + weight[k + 3] * spin
    return out


@wp.struct
class RelativeRates:
    """Velocity of the second body past the first at the contact point, and its spin against it, under plain fields."""

    lam_slide: wp.vec3
    acc_slide: wp.vec3
    vel_slide: wp.vec3
    lam_spin: wp.vec3
    acc_spin: wp.vec3
    vel_spin: wp.vec3


@wp.func
def relative_rates(
    worldid: int, body1: int, body2: int, arm1: wp.vec3, arm2: wp.vec3, motion_in: Motion, fields_in: Fields
) -> RelativeRates:
    """Rates of two bodies at a point with these arms about the centres of mass of their trees."""
    lam1 = fields_in.lam[worldid, body1]
    lam2 = fields_in.lam[worldid, body2]
    acc1 = fields_in.qacc[worldid, body1]
    acc2 = fields_in.qacc[worldid, body2]
    vel1 = motion_in.cvel[worldid, body1]
    vel2 = motion_in.cvel[worldid, body2]
    out = RelativeRates()
    out.lam_slide = point_velocity(lam2, arm2) - point_velocity(lam1, arm1)
    out.acc_slide = point_velocity(acc2, arm2) - point_velocity(acc1, arm1)
    out.vel_slide = point_velocity(vel2, arm2) - point_velocity(vel1, arm1)
    out.lam_spin = wp.spatial_top(lam2) - wp.spatial_top(lam1)
    out.acc_spin = wp.spatial_top(acc2) - wp.spatial_top(acc1)
    out.vel_spin = wp.spatial_top(vel2) - wp.spatial_top(vel1)
    return out


@wp.func
def row_count(dim: int, elliptic: bool) -> int:
    """Rows of a contact: one an axis, or two edges of the pyramid for each axis but the normal."""
    if elliptic or dim == 1:
        return dim
    return 2 * (dim - 1)


@wp.kernel
def pull_contacts(
    in_turn: bool,
    # Model:
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    opt_impratio_invsqrt: wp.array[float],
    shapes: Shapes,
    # In:
    nacon_in: wp.array[int],
    rows_in: Rows,
    laws_in: RowLaws,
    contacts_in: Contacts,
    motion_in: Motion,
    fields_in: Fields,
    # Out:
    bars_out: FieldBars,
    contact_bars_out: ContactBars,
) -> None:
    """Φ ∋ -Σ_r ρ_r(λ) f_r(ρ(a) - aref): wrenches on both bodies, and cotangents of (dist, pos, frame)."""
    start = wp.tid()
    for con in range(start, contacts_end(start, in_turn, nacon_in[0], contacts_in.worldid)):
        contact_bars_out.dist[con] = 0.0
        contact_bars_out.pos[con] = wp.vec3(0.0)
        contact_bars_out.frame[con] = wp.mat33()
        first = contacts_in.efc_address[con, 0]
        if first < 0:
            continue
        worldid = contacts_in.worldid[con]
        dim = contacts_in.dim[con]
        elliptic = rows_in.type[worldid, first] == ConstraintType.CONTACT_ELLIPTIC
        count = row_count(dim, elliptic)
        if contacts_in.efc_address[con, count - 1] < 0:
            continue
        friction = contacts_in.friction[con]
        mu = friction[0] * opt_impratio_invsqrt[worldid % opt_impratio_invsqrt.shape[0]]

        # A contact none of whose rows pushes has no slope anywhere.
        jar = vec6()
        mass = vec6()
        active = bool(False)
        if elliptic:
            for i in range(dim):
                jar[i] = laws_in.jar[worldid, first + i]
                mass[i] = rows_in.D[worldid, first + i]
        cone = cone_at(jar, mass, friction, mu, dim)
        if elliptic:
            active = cone.zone != SATISFIED
        else:
            for i in range(count):
                active = active or laws_in.slope[worldid, first + i] != 0.0
        if not active:
            continue

        geoms = contacts_in.geom[con]
        body1 = shapes.geom_bodyid[geoms[0]]
        body2 = shapes.geom_bodyid[geoms[1]]
        point = contacts_in.pos[con]
        frame = contacts_in.frame[con]
        arm1 = point - motion_in.subtree_com[worldid, shapes.body_rootid[body1]]
        arm2 = point - motion_in.subtree_com[worldid, shapes.body_rootid[body2]]
        rates = relative_rates(worldid, body1, body2, arm1, arm2, motion_in, fields_in)
        rate = components(frame, rates.lam_slide, rates.lam_spin, dim)

        timestep = opt_timestep[worldid % opt_timestep.shape[0]]
        pos = contacts_in.dist[con] - contacts_in.includemargin[con]
        solref = contacts_in.solref[con]
        solimp = contacts_in.solimp[con]
        normal_row = row_slopes(opt_disableflags, timestep, solref, solimp, pos)
        lam_bar = vec6()
        acc_bar = vec6()
        vel_bar = vec6()
        dist_bar = float(0.0)
        if elliptic:
            sideways = contacts_in.solreffriction[con]
            if sideways[0] == 0.0 and sideways[1] == 0.0:
                sideways = solref
            side_damping = stiffness_damping(opt_disableflags, timestep, sideways, solimp[1])[1]
            # ∂Φ/∂jar = S ρ(λ) =: y ,  jar = ρ(a) + b ρ(v) + k imp pos (normal row only)
            y = cone_slope(cone, mass, friction, dim, rate)
            work = float(0.0)
            for i in range(dim):
                lam_bar[i] = -cone.force[i]
                acc_bar[i] = y[i]
                vel_bar[i] = wp.where(i == 0, normal_row.damping, side_damping) * y[i]
                work += rate[i] * cone.force[i]
            # f is of degree one in D, whose ratios are fixed: ∂Φ/∂pos ∋ -ρ(λ)·f d(log D)
            dist_bar = normal_row.stiffness * y[0] - normal_row.mass * work
        else:
            for i in range(count):
                row = first + i
                s = laws_in.slope[worldid, row]
                if s != 0.0:
                    f = laws_in.force[worldid, row]
                    k = i / 2 + 1
                    lean = float(0.0)
                    if dim > 1:
                        lean = friction[k - 1] * wp.where(i % 2 == 0, 1.0, -1.0)
                    # ρ_row = ρ₀ ± φ_k ρ_k
                    row_rate = rate[0]
                    if dim > 1:
                        row_rate += lean * rate[k]
                    y_row = s * row_rate
                    lam_bar[0] -= f
                    acc_bar[0] += y_row
                    if dim > 1:
                        lam_bar[k] -= lean * f
                        acc_bar[k] += lean * y_row
                    dist_bar += normal_row.stiffness * y_row - normal_row.mass * row_rate * f
            vel_bar = normal_row.damping * acc_bar

        lam_force = along_frame(frame, lam_bar, 0)
        acc_force = along_frame(frame, acc_bar, 0)
        vel_force = along_frame(frame, vel_bar, 0)
        lam_torque = along_frame(frame, lam_bar, 3)
        acc_torque = along_frame(frame, acc_bar, 3)
        vel_torque = along_frame(frame, vel_bar, 3)

        contact_bars_out.dist[con] = dist_bar
        # ρ moves with the point as ω × dp  ⇒  p̄ = Σ_x ū(x) × ω(x)
        contact_bars_out.pos[con] = (
            wp.cross(lam_force, rates.lam_spin)
            + wp.cross(acc_force, rates.acc_spin)
            + wp.cross(vel_force, rates.vel_spin)
        )
        contact_bars_out.frame[con] = (
            frame_weight(lam_bar, rates.lam_slide, rates.lam_spin)
            + frame_weight(acc_bar, rates.acc_slide, rates.acc_spin)
            + frame_weight(vel_bar, rates.vel_slide, rates.vel_spin)
        )
        for side in range(2):
            body = body1
            arm = arm1
            sign = float(-1.0)
            if side == 1:
                body = body2
                arm = arm2
                sign = float(1.0)
            if body > 0:
                lam = fields_in.lam[worldid, body]
                acc = fields_in.qacc[worldid, body]
                vel = motion_in.cvel[worldid, body]
                lam_wrench = sign * wrench(lam_force, lam_torque, arm)
                acc_wrench = sign * wrench(acc_force, acc_torque, arm)
                vel_wrench = sign * wrench(vel_force, vel_torque, arm)
                wp.atomic_add(bars_out.lam, worldid, body, lam_wrench)
                wp.atomic_add(bars_out.qacc, worldid, body, acc_wrench)
                wp.atomic_add(bars_out.qvel, worldid, body, vel_wrench)
                moved = carried(lam, lam_wrench) + carried(acc, acc_wrench) + carried(vel, vel_wrench)
                wp.atomic_add(bars_out.moved, worldid, body, moved)


class ContactForces:
    """Launches of the contacts' part of ∂Φ, through their rows and through their geometry.

    Attributes:
        count: contacts of all worlds that there is room for.
    """

    def __init__(self, work: Workspace, contacts: int) -> None:
        self._work, self.count, self._keeps = work, contacts, False
        mjm = work.mjm
        types = {(int(mjm.geom_type[a]), int(mjm.geom_type[b])) for a, b in colliding_pairs(mjm)}
        self._pull_geometry = pull_geometry_kernel(PairKinds.of(types))
        self._bars = allocate(ContactBars, contacts)
        self._has_convex = bool(types & CONVEX_PAIRS)

    def keep_wrenches(self) -> None:
        """Let launches recorded from now on write `contact_wrenches` of the workspace."""
        if not self._keeps:
            self._keeps = True
            self._work.contact_wrenches = wp.zeros((self.count, 2), dtype=wp.spatial_vector)

    def launch(self, at: Substep) -> None:
        """Launch all of them."""
        work = self._work
        work.launch(pull_contacts, self.count, at, self._bars)
        work.launch(self._pull_geometry, self.count, at, self._bars)
        if self._has_convex:
            work.launch(pull_convex, self.count, at, self._bars)
