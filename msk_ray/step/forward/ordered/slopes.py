"""The matrix M - h ∂τ/∂v of the implicitfast integrator, with the actuators' terms added in order.

In mujoco_warp the threads of all actuators add to it at once. Here its public functions see actuators without velocity
dependence, which add nothing, and one thread per entry subtracts the actuators' terms.
"""

import copy
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from msk_ray.step.forward.mjw_private import actuator_velocity_slopes

wp.set_module_options({"enable_backward": False})


def slopes_apart(mjm: mujoco.MjModel, model: Any) -> bool:
    """Whether only actuators race for this matrix, and nothing else in a step uses their velocity dependence: no fluid,
    no separately integrated free body, no DC motor, no delayed control."""
    kinds = [int(value) for value in (*mjm.actuator_dyntype, *mjm.actuator_biastype)]
    motors = any(value == int(mjw.DynType.DCMOTOR) or value == int(mjw.BiasType.DCMOTOR) for value in kinds)
    return not (motors or model.has_fluid or model.body_freeadr.size or model.nhistory)


@wp.kernel
def subtract_slopes(
    # Model:
    opt_timestep: wp.array[float],
    M_elemid: wp.array2d[int],
    M_fullm_i: wp.array[int],
    M_fullm_j: wp.array[int],
    # In:
    rownnz_in: wp.array2d[int],
    rowadr_in: wp.array2d[int],
    colind_in: wp.array2d[int],
    moment_in: wp.array2d[float],
    slope_in: wp.array2d[float],
    matrix_in: wp.array2d[float],
    # Out:
    matrix_out: wp.array2d[float],
) -> None:
    """Compute an entry (i, j) of M - h Σ m_i m_j dF/dv over the actuators, with their moments m."""
    worldid, pair = wp.tid()
    i = M_fullm_i[pair]
    j = M_fullm_j[pair]
    entry = M_elemid[i, j]
    if entry < 0:
        return
    total = float(0.0)
    for u in range(slope_in.shape[1]):
        slope = slope_in[worldid, u]
        if slope != 0.0:
            first = rowadr_in[worldid, u]
            moment_i = float(0.0)
            moment_j = float(0.0)
            for k in range(first, first + rownnz_in[worldid, u]):
                if colind_in[worldid, k] == i:
                    moment_i = moment_in[worldid, k]
                if colind_in[worldid, k] == j:
                    moment_j = moment_in[worldid, k]
            total += moment_i * moment_j * slope
    h = opt_timestep[worldid % opt_timestep.shape[0]]
    matrix_out[worldid, entry] = matrix_in[worldid, entry] - h * total


class SlopeOrder:
    """Launches of the matrix, and of the integration with it.

    Args:
        mjm: the MjModel.
        model: mujoco_warp's model of it, before it is sealed; `slopes_apart`.
    """

    def __init__(self, mjm: mujoco.MjModel, model: Any) -> None:
        self._still = copy.copy(model)
        self._still.actuator_gaintype = wp.full_like(model.actuator_gaintype, int(mjw.GainType.FIXED))
        self._still.actuator_biastype = wp.full_like(model.actuator_biastype, int(mjw.BiasType.NONE))
        flags = mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_DAMPER
        # As in mujoco_warp, which uses M itself if either is disabled.
        self._active = bool(np.size(mjm.actuator_gaintype)) and not mjm.opt.disableflags & flags
        self._scratch: dict[int, tuple[wp.array, wp.array]] = {}

    def launch(self, model: Any, data: Any, out: wp.array) -> None:
        """Launch the matrix of a world, in the layout of M, into `out` (W, nC)."""
        mjw.deriv_smooth_vel(self._still, data, out)
        if self._active:
            self._subtract(model, data, out, out)

    def integrate(self, model: Any, data: Any) -> None:
        """Launch `mujoco_warp.implicit`."""
        own = data
        if self._active:
            # mujoco_warp subtracts dampers from M. Everything else that reads M is already done.
            own = copy.copy(data)
            own.M = self._arrays(model, data)[1]
            self._subtract(model, data, data.M, own.M)  # writes all entries
        mjw.implicit(self._still, own)

    def _subtract(self, m: Any, d: Any, matrix: wp.array, out: wp.array) -> None:
        slope = self._arrays(m, d)[0]
        wp.launch(
            actuator_velocity_slopes,
            dim=(d.nworld, m.nactuator),
            inputs=[
                *(m.opt.timestep, m.opt.disableflags, m.jnt_dofadr, m.jnt_actfrclimited, m.jnt_actfrcrange),
                *(m.tendon_actfrclimited, m.tendon_actfrcrange, m.actuator_trntype, m.actuator_dyntype),
                *(m.actuator_gaintype, m.actuator_biastype, m.actuator_ctrladr, m.actuator_ctrlnum),
                *(m.actuator_ctrlspec, m.actuator_actadr, m.actuator_actnum, m.actuator_trnid, m.actuator_dynprm),
                *(m.actuator_gainprm, m.actuator_biasprm, m.actuator_actlimited, m.actuator_actrange),
                *(m.actuator_actearly, m.actuator_forcelimited, m.actuator_forcerange, m.actuator_ctrllimited),
                *(m.actuator_ctrlrange, m.actuator_acc0, m.actuator_lengthrange),
                *(d.act, d.ctrl, d.act_dot, d.actuator_length, d.actuator_velocity, d.actuator_force),
                d.qfrc_actuator,
            ],
            outputs=[slope],
        )
        wp.launch(
            subtract_slopes,
            dim=(d.nworld, m.M_fullm_i.size),
            inputs=[
                *(m.opt.timestep, m.M_elemid, m.M_fullm_i, m.M_fullm_j),
                *(d.moment_rownnz, d.moment_rowadr, d.moment_colind, d.actuator_moment, slope, matrix),
            ],
            outputs=[out],
        )

    def _arrays(self, model: Any, data: Any) -> tuple[wp.array, wp.array]:
        """Scratch: dF/dv of the actuators (W, U), and a matrix in the layout of M."""
        if data.nworld not in self._scratch:
            slope = wp.zeros((data.nworld, model.nactuator), dtype=float)
            self._scratch[data.nworld] = slope, wp.zeros_like(data.M)
        return self._scratch[data.nworld]
