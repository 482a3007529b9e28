"""The time step: v' = v + h â, q' = q ⊕ h v', and the implicit damping of (M + hB) â = M a.

    h̄ = q̄'·v' + v̄'·â - μᵀ B â ,   h B â = M (a - â)

besides what constraints give it (a time constant is held above 2 h) and activations (act' = act + h·rate).
"""

import warp as wp

from msk_ray.step.adjoint.groups import Multipliers, State, Substep, TimestepGradient
from msk_ray.step.adjoint.parameters.base import ParameterFamily

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pull_step_of_position(
    # In:
    live_in: wp.array[int],
    grad_qpos_in: wp.array2d[float],
    qvel_next_in: wp.array2d[float],
    # Out:
    gradient_out: TimestepGradient,
) -> None:
    """h̄ += q̄'·v' of one dof, in tangent coordinates at q'."""
    worldid, j = wp.tid()
    if live_in[worldid] != 0:
        wp.atomic_add(gradient_out.timestep, worldid, grad_qpos_in[worldid, j] * qvel_next_in[worldid, j])


@wp.kernel
def pull_step_of_velocity(
    # Model:
    opt_timestep: wp.array[float],
    inertia_address: wp.array2d[int],
    # In:
    live_in: wp.array[int],
    M_in: wp.array2d[float],
    rhs_in: wp.array2d[float],
    state_in: State,
    multipliers_in: Multipliers,
    # Out:
    gradient_out: TimestepGradient,
) -> None:
    """h̄ += v̄'·â - μ·M(a - â)/h of one dof, where the right-hand side of μ is h v̄'."""
    worldid, j = wp.tid()
    if live_in[worldid] == 0:
        return
    lost = float(0.0)
    for i in range(inertia_address.shape[0]):
        address = inertia_address[wp.max(i, j), wp.min(i, j)]
        if address >= 0:
            lost += M_in[worldid, address] * multipliers_in.excess[worldid, i]
    smooth = state_in.qacc[worldid, j] - multipliers_in.excess[worldid, j]
    slope = rhs_in[worldid, j] * smooth - multipliers_in.mu[worldid, j] * lost
    wp.atomic_add(gradient_out.timestep, worldid, slope / opt_timestep[worldid % opt_timestep.shape[0]])


class TimestepFamily(ParameterFamily):
    """Launches of what the integration of positions and velocities gives the time step."""

    kinds = (TimestepGradient,)

    def launch_first(self, at: Substep, qvel_next: wp.array) -> None:
        self.work.launch(pull_step_of_position, self.work.rhs.shape, at, *self.gradients, qvel_next=qvel_next)

    def launch(self, at: Substep) -> None:
        self.work.launch(pull_step_of_velocity, self.work.rhs.shape, at, *self.gradients)
