"""Kinematics and tendon lengths by C MuJoCo in float64: a reference for gradients, itself without gradients.

Axes: W worlds, B bodies.
"""

from collections.abc import Iterator

import mujoco
import numpy as np
import torch
from torch import Tensor

from msk_ray.step.autograd.kinematics import Frames, Kinematics
from msk_ray.step.autograd.tendon_lengths import Tendons


class ExactKinematics(Kinematics):
    """`Kinematics` by C MuJoCo, for any number of worlds."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self._device = torch.device("cpu")
        self.body_frame = torch.arange(model.nbody)
        self.constants = self._constants()
        self._found = {}

    def __call__(self, qpos: Tensor, qvel: Tensor) -> Frames:
        """Frames of the states qpos (W, nq) and qvel (W, nv)."""
        frames = []
        twist = np.zeros(6)
        for data in _worlds(self.model, qpos, qvel):
            twists = np.zeros((self.model.nbody, 6))
            for body in range(self.model.nbody):
                mujoco.mj_objectVelocity(self.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
                twists[body] = twist
            frames.append(np.hstack((data.xpos, np.roll(data.xquat, -1, axis=1), twists)))
        values = self.tensor(np.stack(frames))
        pos, quat, angvel, linvel = values.split((3, 4, 3, 3), dim=-1)
        return Frames(self, pos, quat, linvel, angvel)

    def tensor(self, values: object, dtype: torch.dtype = torch.float64) -> Tensor:
        return super().tensor(values, dtype)


class ExactTendons(Tendons):
    """`Tendons` by C MuJoCo, for any number of worlds."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model

    def __call__(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """Lengths and rates, each (W, ntendon), of states qpos (W, nq) and qvel (W, nv)."""
        tendons = [(d.ten_length.copy(), d.ten_velocity.copy()) for d in _worlds(self._model, qpos, qvel)]
        length, rate = (torch.from_numpy(np.stack(part)) for part in zip(*tendons, strict=True))
        return length, rate


def _worlds(model: mujoco.MjModel, qpos: Tensor, qvel: Tensor) -> Iterator[mujoco.MjData]:
    """One MjData, filled for each world in turn."""
    data = mujoco.MjData(model)
    for position, velocity in zip(qpos, qvel, strict=True):
        data.qpos[:], data.qvel[:] = position.numpy(), velocity.numpy()
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        yield data
