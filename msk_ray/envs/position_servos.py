"""Which actuators of a model are position servos."""

import mujoco
import numpy as np
from numpy.typing import NDArray


def position_servos(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """True for each actuator whose force is kp (ctrl − length) − kd velocity with kp > 0, (nu,)."""
    kp = model.actuator_gainprm[:, 0]
    fixed = model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    servo: NDArray[np.bool_] = fixed & affine & (kp > 0.0) & (model.actuator_biasprm[:, 1] == -kp)
    return servo
