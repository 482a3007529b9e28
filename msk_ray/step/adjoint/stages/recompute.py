"""Recomputing the stages of a mujoco_warp step that its adjoint reads, without solving for the acceleration."""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np

from msk_ray.step.forward.batch import refresh_velocity
from msk_ray.step.forward.stages import Stages


def recompute_stages(mjm: mujoco.MjModel, model: Any, data: Any, stages: Stages) -> None:
    """Launch the position and velocity stages of the state in `data`."""
    refresh_velocity(mjm, model, data)
    stages.position(model, data)
    implicit = mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if implicit or np.any(mjm.jnt_actfrclimited):
        # The implicit matrix needs actuator forces, and joints at their actuator force limit are known by the total.
        mjw.fwd_velocity(stages.summing(model), data)
        mjw.fwd_actuation(stages.summing(model), data)
    else:
        mjw.com_vel(model, data)
