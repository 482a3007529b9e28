"""Tendons: passive forces, and cotangents of length and rates pulled back.

A tendon's rate under a plain field x is ρ(x) = J x. Φ holds tendons through their length l and through ρ(v), ρ(λ),
ρ(a), and with implicit integration also ρ(μ) and ρ(a - â). J l̄ is the gradient that any tendon has; how a spatial
tendon's J turns with q is worked out in `paths`, segment by segment.
"""

import warp as wp

from msk_ray.step.adjoint.groups import DofSlopes, Multipliers, State, Substep, TendonBars, TendonRows
from msk_ray.step.adjoint.laws.tendon_paths import TendonPaths
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import WrapType, tendon_damping_total

wp.set_module_options({"enable_backward": False})


@wp.func
def tendon_rate(tendons: TendonRows, t: int, jacobian: wp.array[float], x: wp.array[float]) -> float:
    """J x of one tendon in one world."""
    rate = float(0.0)
    start = tendons.ten_J_rowadr[t]
    for k in range(start, start + tendons.ten_J_rownnz[t]):
        rate += jacobian[k] * x[tendons.ten_J_colind[k]]
    return rate


@wp.func
def implicit_pairs(
    worldid: int,
    t: int,
    tendons: TendonRows,
    address: wp.array2d[int],
    ten_J_in: wp.array2d[float],
    state_in: State,
    multipliers_in: Multipliers,
) -> float:
    """κ = Σ J_i J_j μ_i â_j of one tendon, over the pairs of dofs that have an address."""
    kappa = float(0.0)
    start = tendons.ten_J_rowadr[t]
    end = start + tendons.ten_J_rownnz[t]
    for k in range(start, end):
        i = tendons.ten_J_colind[k]
        for m in range(start, end):
            j = tendons.ten_J_colind[m]
            if address[wp.max(i, j), wp.min(i, j)] >= 0:
                smooth = state_in.qacc[worldid, j] - multipliers_in.excess[worldid, j]
                kappa += ten_J_in[worldid, k] * ten_J_in[worldid, m] * multipliers_in.mu[worldid, i] * smooth
    return kappa


@wp.struct
class TendonLaw:
    """What the force of one tendon's spring and damper depends on besides its length and rate."""

    rest: wp.vec2
    stiffness: wp.float32
    stiffness_poly: wp.vec2
    damping: wp.float32
    """That of actuators included."""
    damping_poly: wp.vec2


@wp.func
def tendon_potential(
    law: TendonLaw, length: wp.float32, rate: wp.float32, rate_lam: wp.float32, kappa: wp.float32
) -> wp.float32:
    """ρ(λ) (k(x) x + c(|ρ|) ρ) + h κ d(cρ)/dρ, x how far a tendon is out of the dead band of its spring."""
    x = wp.float32(0.0)
    if length < law.rest[0]:
        x = length - law.rest[0]
    elif length > law.rest[1] or law.rest[0] == law.rest[1]:  # without a dead band there is stiffness at rest too
        x = length - law.rest[1]
    spring = x * (law.stiffness + law.stiffness_poly[0] * x + law.stiffness_poly[1] * x * x)
    speed = wp.abs(rate)
    damper = rate * (law.damping + law.damping_poly[0] * speed + law.damping_poly[1] * speed * speed)
    slope = law.damping + 2.0 * law.damping_poly[0] * speed + 3.0 * law.damping_poly[1] * speed * speed
    return rate_lam * (spring + damper) + kappa * slope


@wp.struct
class TendonGradients:
    """Gradients by tendon, (W, T)."""

    tendon_stiffness: wp.array2d[float]
    tendon_damping: wp.array2d[float]
    tendon_lengthspring: wp.array2d[wp.vec2]


@wp.struct
class PassiveTendons:
    """Springs and dampers of tendons, the damping of actuators included."""

    tendon_actuatorid: wp.array[int]
    tendon_stiffness: wp.array2d[float]
    tendon_stiffnesspoly: wp.array2d[wp.vec2]
    tendon_damping: wp.array2d[float]
    tendon_dampingpoly: wp.array2d[wp.vec2]
    tendon_lengthspring: wp.array2d[wp.vec2]
    actuator_trntype: wp.array[int]
    actuator_trnid: wp.array[wp.vec2i]
    actuator_damping: wp.array2d[float]
    actuator_dampingpoly: wp.array2d[wp.vec2]
    actuator_gear: wp.array2d[wp.spatial_vector]


@wp.kernel
def start_tendons(
    # Model:
    opt_timestep: wp.array[float],
    spring_on: bool,
    damper_on: bool,
    implicit_all: bool,
    tendons: TendonRows,
    passive: PassiveTendons,
    implicit_address: wp.array2d[int],
    # In:
    live_in: wp.array[int],
    state_in: State,
    ten_J_in: wp.array2d[float],
    ten_length_in: wp.array2d[float],
    multipliers_in: Multipliers,
    # Out:
    tendon_bars_out: TendonBars,
    gradients_out: TendonGradients,
) -> None:
    """Starts each tendon's cotangents with those of its spring and damper, and adds gradients of their parameters.

    With implicit integration Φ ∋ h μᵀ B â where B ∋ d(c ρ)/dρ J Jᵀ on the entries that `implicit_address` has.
    """
    worldid, t = wp.tid()
    keeps = live_in[worldid] != 0 and gradients_out.tendon_damping.shape[0] > 0
    rate_v = tendon_rate(tendons, t, ten_J_in[worldid], state_in.qvel[worldid])
    rate_l = tendon_rate(tendons, t, ten_J_in[worldid], multipliers_in.lam[worldid])
    law = TendonLaw()
    if spring_on:
        law.rest = passive.tendon_lengthspring[worldid % passive.tendon_lengthspring.shape[0], t]
        law.stiffness = passive.tendon_stiffness[worldid % passive.tendon_stiffness.shape[0], t]
        law.stiffness_poly = passive.tendon_stiffnesspoly[worldid % passive.tendon_stiffnesspoly.shape[0], t]
    if damper_on:
        c, bend = tendon_damping_total(
            passive.tendon_actuatorid,
            passive.tendon_damping,
            passive.tendon_dampingpoly,
            passive.actuator_trntype,
            passive.actuator_trnid,
            passive.actuator_damping,
            passive.actuator_dampingpoly,
            passive.actuator_gear,
            worldid,
            t,
        )
        law.damping = c
        law.damping_poly = bend
    h = float(0.0)
    kappa = float(0.0)
    if implicit_all and damper_on and tendons.ten_J_rownnz[t] > 0:
        dof = tendons.ten_J_colind[tendons.ten_J_rowadr[t]]
        damped = law.damping != 0.0 or law.damping_poly[0] != 0.0 or law.damping_poly[1] != 0.0
        # A tendon of a lone free body, which has no address, acts on no other dofs.
        if implicit_address[dof, dof] >= 0 and (damped or keeps):
            h = opt_timestep[worldid % opt_timestep.shape[0]]
            kappa = h * implicit_pairs(worldid, t, tendons, implicit_address, ten_J_in, state_in, multipliers_in)
    law_bar, length_bar, qvel_bar, lam_bar, slope = wp.grad(tendon_potential)(
        law, ten_length_in[worldid, t], rate_v, rate_l, kappa
    )
    mu_bar = float(0.0)
    smooth_bar = float(0.0)
    if h > 0.0:
        rate_mu = tendon_rate(tendons, t, ten_J_in[worldid], multipliers_in.mu[worldid])
        rate_a = tendon_rate(tendons, t, ten_J_in[worldid], state_in.qacc[worldid])
        rate_e = tendon_rate(tendons, t, ten_J_in[worldid], multipliers_in.excess[worldid])
        mu_bar = h * slope * (rate_a - rate_e)
        smooth_bar = h * slope * rate_mu
    tendon_bars_out.length[worldid, t] = length_bar
    tendon_bars_out.qvel[worldid, t] = qvel_bar
    tendon_bars_out.lam[worldid, t] = lam_bar
    tendon_bars_out.qacc[worldid, t] = 0.0
    tendon_bars_out.mu[worldid, t] = mu_bar
    tendon_bars_out.smooth[worldid, t] = smooth_bar
    if keeps and spring_on:
        gradients_out.tendon_stiffness[worldid, t] -= law_bar.stiffness
        gradients_out.tendon_lengthspring[worldid, t] -= law_bar.rest
    if keeps and damper_on:
        gradients_out.tendon_damping[worldid, t] -= law_bar.damping


@wp.kernel
def pull_tendons(
    lanes: int,
    count: int,
    width: int,
    # Model:
    tendons: TendonRows,
    tendon_adr: wp.array[int],
    wrap_type: wp.array[int],
    # In:
    ten_J_in: wp.array2d[float],
    tendon_bars_in: TendonBars,
    # Out:
    slopes_out: DofSlopes,
) -> None:
    """∂Φ/∂q ∋ J l̄, and for fixed tendons ∂Φ/∂v ∋ J ρ̄(v); spatial ones give that to their bodies."""
    worldid, lane = wp.tid()
    for entry in range(lane, count * width, lanes):
        t = entry // width
        k = entry % width
        if k < tendons.ten_J_rownnz[t]:
            place = tendons.ten_J_rowadr[t] + k
            dof = tendons.ten_J_colind[place]
            j = ten_J_in[worldid, place]
            wp.atomic_add(slopes_out.qpos, worldid, dof, j * tendon_bars_in.length[worldid, t])
            if wrap_type[tendon_adr[t]] == WrapType.JOINT:
                wp.atomic_add(slopes_out.qvel, worldid, dof, j * tendon_bars_in.qvel[worldid, t])


class Tendons:
    """Launches that start the tendons' cotangents and, when all is added to them, pull them back.

    Attributes:
        paths: those of spatial tendons, if there are any.
    """

    def __init__(self, work: Workspace) -> None:
        self._work = work
        self.paths = TendonPaths(work) if work.tables.segment_tendon.size else None

    def launch_start(self, at: Substep) -> None:
        """Launch the cotangents that springs and dampers give."""
        work = self._work
        work.launch(start_tendons, (work.nworld, work.model.ntendon), at, at.gradient(TendonGradients))

    def launch_pullback(self, at: Substep) -> None:
        """Launch what the cotangents give to dofs and bodies."""
        work, m = self._work, self._work.model
        lanes = work.lanes(m.ntendon * m.max_ten_J_rownnz)
        count = {"lanes": lanes, "count": m.ntendon, "width": m.max_ten_J_rownnz}
        work.launch(pull_tendons, (work.nworld, lanes), at, **count)
        if self.paths is not None:
            self.paths.launch(at)
