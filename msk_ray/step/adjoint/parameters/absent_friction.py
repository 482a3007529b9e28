"""Friction losses of zero, which make no rows; those that do, with limits and equalities, are in `laws.scalar_rows`."""

import warp as wp

from msk_ray.step.adjoint.groups import State, Substep, TendonRows
from msk_ray.step.adjoint.laws.impedance import stiffness_damping
from msk_ray.step.adjoint.laws.scalar_rows import RowGradients, RowSettings
from msk_ray.step.adjoint.laws.tendons import tendon_rate
from msk_ray.step.adjoint.parameters.base import ParameterFamily
from msk_ray.step.forward.mjw_private import vec5

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pull_absent_friction(
    # Model:
    nv: int,
    opt_timestep: wp.array[float],
    opt_disableflags: int,
    settings: RowSettings,
    dof_frictionloss: wp.array2d[float],
    tendon_frictionloss: wp.array2d[float],
    tendons: TendonRows,
    # In:
    count: int,
    lanes: int,
    live_in: wp.array[int],
    state_in: State,
    lam_in: wp.array2d[float],
    ten_J_in: wp.array2d[float],
    # Out:
    gradients_out: RowGradients,
) -> None:
    """A dof or tendon without friction loss has no row, but a slope: f = -loss sign(ρ(a) + b ρ(v)) for small ones."""
    worldid, lane = wp.tid()
    if live_in[worldid] == 0:
        return
    for place in range(lane, count, lanes):
        loss = float(0.0)
        lam = float(0.0)
        acc = float(0.0)
        vel = float(0.0)
        solref = wp.vec2(0.0)
        solimp = vec5()
        t = place - nv
        if t < 0:
            loss = dof_frictionloss[worldid % dof_frictionloss.shape[0], place]
            lam = lam_in[worldid, place]
            acc = state_in.qacc[worldid, place]
            vel = state_in.qvel[worldid, place]
            solref = settings.dof_solref[worldid % settings.dof_solref.shape[0], place]
            solimp = settings.dof_solimp[worldid % settings.dof_solimp.shape[0], place]
        else:
            loss = tendon_frictionloss[worldid % tendon_frictionloss.shape[0], t]
            lam = tendon_rate(tendons, t, ten_J_in[worldid], lam_in[worldid])
            acc = tendon_rate(tendons, t, ten_J_in[worldid], state_in.qacc[worldid])
            vel = tendon_rate(tendons, t, ten_J_in[worldid], state_in.qvel[worldid])
            solref = settings.tendon_solref_fri[worldid % settings.tendon_solref_fri.shape[0], t]
            solimp = settings.tendon_solimp_fri[worldid % settings.tendon_solimp_fri.shape[0], t]
        if loss > 0.0:
            continue
        timestep = opt_timestep[worldid % opt_timestep.shape[0]]
        jar = acc + stiffness_damping(opt_disableflags, timestep, solref, solimp[1])[1] * vel
        slope = float(0.0)
        if jar != 0.0:
            slope = -lam * wp.sign(jar)
        if t < 0:
            gradients_out.dof_frictionloss[worldid, place] = gradients_out.dof_frictionloss[worldid, place] + slope
        else:
            gradients_out.tendon_frictionloss[worldid, t] = gradients_out.tendon_frictionloss[worldid, t] + slope


class AbsentFrictionFamily(ParameterFamily):
    """Launches of the gradients of friction losses of zero."""

    kinds = (RowGradients,)

    def launch(self, at: Substep) -> None:
        work, m = self.work, self.work.model
        work.launch_lanes(pull_absent_friction, m.nv + m.ntendon, at, *self.gradients, lam=work.multipliers.lam)
