"""Stiffness, damping and rest length of tendons: Φ ∋ ρ(λ) (k(x) x + c ρ(v)), and h κ c with implicit integration."""

import warp as wp

from msk_ray.step.adjoint.groups import Multipliers, State, Substep, TendonRows
from msk_ray.step.adjoint.laws.tendons import PassiveTendons, implicit_pairs, stretch_of, tendon_rate
from msk_ray.step.adjoint.parameters.base import ParameterStage
from msk_ray.step.forward.mjw_private import poly_force_deriv

wp.set_module_options({"enable_backward": False})


@wp.struct
class TendonGradients:
    """Gradients by tendon, (W, T)."""

    tendon_stiffness: wp.array2d[float]
    tendon_damping: wp.array2d[float]
    tendon_lengthspring: wp.array2d[wp.vec2]


@wp.kernel
def pull_tendon_parameters(
    # Model:
    opt_timestep: wp.array[float],
    spring_on: bool,
    damper_on: bool,
    implicit_all: bool,
    tendons: TendonRows,
    passive: PassiveTendons,
    inertia_address: wp.array2d[int],
    # In:
    live_in: wp.array[int],
    state_in: State,
    ten_J_in: wp.array2d[float],
    ten_length_in: wp.array2d[float],
    multipliers_in: Multipliers,
    # Out:
    gradients_out: TendonGradients,
) -> None:
    """θ̄ -= ∂Φ/∂θ of one tendon's spring and damper."""
    worldid, t = wp.tid()
    if live_in[worldid] == 0:
        return
    rate_l = tendon_rate(tendons, t, ten_J_in[worldid], multipliers_in.lam[worldid])
    if spring_on:
        rest = passive.tendon_lengthspring[worldid % passive.tendon_lengthspring.shape[0], t]
        stiffness = passive.tendon_stiffness[worldid % passive.tendon_stiffness.shape[0], t]
        poly = passive.tendon_stiffnesspoly[worldid % passive.tendon_stiffnesspoly.shape[0], t]
        x = stretch_of(ten_length_in[worldid, t], rest)
        bar = wp.vec2(0.0)
        if x > 0.0:
            bar[1] = rate_l * poly_force_deriv(stiffness, poly, x, 0)
        elif x < 0.0:
            bar[0] = rate_l * poly_force_deriv(stiffness, poly, x, 0)
        gradients_out.tendon_stiffness[worldid, t] = gradients_out.tendon_stiffness[worldid, t] - rate_l * x
        gradients_out.tendon_lengthspring[worldid, t] = gradients_out.tendon_lengthspring[worldid, t] + bar
    if damper_on:
        slope = rate_l * tendon_rate(tendons, t, ten_J_in[worldid], state_in.qvel[worldid])
        if implicit_all:
            h = opt_timestep[worldid % opt_timestep.shape[0]]
            slope += h * implicit_pairs(worldid, t, tendons, inertia_address, ten_J_in, state_in, multipliers_in)
        gradients_out.tendon_damping[worldid, t] = gradients_out.tendon_damping[worldid, t] - slope


class TendonStage(ParameterStage):
    """Launches of the gradients of tendons' springs and dampers."""

    kinds = (TendonGradients,)

    def launch(self, at: Substep) -> None:
        self.work.launch(pull_tendon_parameters, (self.work.nworld, self.work.model.ntendon), at, *self.gradients)
