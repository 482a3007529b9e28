"""Recomputing the stages of a mujoco_warp step that its adjoint reads, without solving for the acceleration."""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
from mujoco_warp import deriv_smooth_vel

from msk_ray.physics.batch import refresh_velocity


def recompute_stages(mjm: mujoco.MjModel, model: Any, data: Any) -> None:
    """Launch the position and velocity stages of the state in `data`."""
    refresh_velocity(mjm, model, data)
    mjw.fwd_position(model, data, factorize=False)
    implicit = mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if implicit or np.any(mjm.jnt_actfrclimited):
        # The implicit matrix needs actuator forces, and joints at their actuator force limit are known by the total.
        mjw.fwd_velocity(model, data)
        mjw.fwd_actuation(model, data)
    else:
        mjw.com_vel(model, data)


def implicit_matrix(model: Any, data: Any, out: Any) -> None:
    """Launch M - h ∂τ/∂v of the implicitfast integrator into `out`, in the sparse layout of M."""
    deriv_smooth_vel(model, data, out)
