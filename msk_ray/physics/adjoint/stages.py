"""Recomputing the stages of a mujoco_warp step that its adjoint reads, without solving for the acceleration."""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np


def recompute_stages(mjm: mujoco.MjModel, model: Any, data: Any) -> None:
    """Launch the position and velocity stages of the state in `data`."""
    mjw.fwd_position(model, data, factorize=False)
    mjw.com_vel(model, data)
    if np.any(mjm.jnt_actfrclimited):
        # Which joints sit at their actuator force limit is known from the total force only.
        mjw.fwd_velocity(model, data)
        mjw.fwd_actuation(model, data)
