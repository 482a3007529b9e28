"""Tendons: passive forces, and cotangents of length and rates pulled back.

A tendon's rate under a plain field x is ρ(x) = J x. Φ holds tendons through their length l and through ρ(v), ρ(λ),
ρ(a), and with implicit integration also ρ(μ) and ρ(a - â). J l̄ is the gradient that any tendon has; how a spatial
tendon's J turns with q is worked out in `paths`, segment by segment.
"""

import warp as wp

from msk_ray.step.adjoint.groups import DofSlopes, Multipliers, State, Substep, TendonBars, TendonRows
from msk_ray.step.adjoint.laws.tendon_paths import TendonPaths
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import WrapType, poly_force_deriv, tendon_damping_total

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


@wp.func
def stretch_of(length: float, rest: wp.vec2) -> float:
    """x: how far a tendon is out of the dead band of its spring, negative where it is shorter."""
    x = float(0.0)
    if length > rest[1]:
        x = length - rest[1]
    elif length < rest[0]:
        x = length - rest[0]
    return x


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
    state_in: State,
    ten_J_in: wp.array2d[float],
    ten_length_in: wp.array2d[float],
    multipliers_in: Multipliers,
    # Out:
    tendon_bars_out: TendonBars,
) -> None:
    """Starts each tendon's cotangents with those of its spring and damper: Φ ∋ ρ(λ) (k(x) x + c(|ρ(v)|) ρ(v)).

    With implicit integration also Φ ∋ h μᵀ B â where B ∋ d(c ρ)/dρ J Jᵀ on the entries that `implicit_address` has.
    """
    worldid, t = wp.tid()
    rate_v = tendon_rate(tendons, t, ten_J_in[worldid], state_in.qvel[worldid])
    rate_l = tendon_rate(tendons, t, ten_J_in[worldid], multipliers_in.lam[worldid])
    length_bar = float(0.0)
    qvel_bar = float(0.0)
    lam_bar = float(0.0)
    mu_bar = float(0.0)
    smooth_bar = float(0.0)
    if spring_on:
        rest = passive.tendon_lengthspring[worldid % passive.tendon_lengthspring.shape[0], t]
        stiffness = passive.tendon_stiffness[worldid % passive.tendon_stiffness.shape[0], t]
        poly = passive.tendon_stiffnesspoly[worldid % passive.tendon_stiffnesspoly.shape[0], t]
        x = stretch_of(ten_length_in[worldid, t], rest)
        # A spring without a dead band has its stiffness at rest too.
        if x != 0.0 or rest[0] == rest[1]:
            lam_bar += x * (stiffness + poly[0] * x + poly[1] * x * x)
            length_bar += rate_l * poly_force_deriv(stiffness, poly, x, 0)
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
        speed = wp.abs(rate_v)
        slope = poly_force_deriv(c, bend, rate_v, 1)
        lam_bar += rate_v * (c + bend[0] * speed + bend[1] * speed * speed)
        qvel_bar += rate_l * slope
        start = tendons.ten_J_rowadr[t]
        held = bool(True)
        if tendons.ten_J_rownnz[t] > 0:
            # A tendon of a lone free body acts on no other dofs.
            held = implicit_address[tendons.ten_J_colind[start], tendons.ten_J_colind[start]] < 0
        if implicit_all and not held and (c != 0.0 or bend[0] != 0.0 or bend[1] != 0.0):
            h = opt_timestep[worldid % opt_timestep.shape[0]]
            kappa = implicit_pairs(worldid, t, tendons, implicit_address, ten_J_in, state_in, multipliers_in)
            qvel_bar += h * kappa * wp.sign(rate_v) * (2.0 * bend[0] + 6.0 * bend[1] * speed)
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
        work.launch(start_tendons, (work.nworld, work.model.ntendon), at)

    def launch_pullback(self, at: Substep) -> None:
        """Launch what the cotangents give to dofs and bodies."""
        work, m = self._work, self._work.model
        lanes = work.lanes(m.ntendon * m.max_ten_J_rownnz)
        count = {"lanes": lanes, "count": m.ntendon, "width": m.max_ten_J_rownnz}
        work.launch(pull_tendons, (work.nworld, lanes), at, **count)
        if self.paths is not None:
            self.paths.launch(at)
