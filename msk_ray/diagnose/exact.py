"""What is measured of a state, by C MuJoCo in float64: a reference for gradients, itself without gradients.

Axes: W worlds, B bodies.
"""

import copy
from collections.abc import Iterator
from functools import cached_property

import mujoco
import numpy as np
import torch
from torch import Tensor

from msk_ray.step.autograd.ground import Ground
from msk_ray.step.autograd.kinematics import Frames, Kinematics
from msk_ray.step.autograd.tendon_lengths import Tendons
from msk_ray.step.forward.ground_rays import ground_geoms


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


class ExactGround(Ground):
    """`Ground` by C MuJoCo, for any number of worlds."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model

    @cached_property
    def _scene(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """A copy of the model in which group 0 is the ground, visible to rays."""
        model = copy.copy(self._model)
        model.geom_group[:] = 1
        model.geom_group[ground_geoms(model)] = 0
        model.geom_matid[:], model.geom_rgba[:] = -1, 1.0
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        return model, data

    def below(self, points: Tensor, reach: float) -> Tensor:
        """How far the ground is straight below points (W, R, 3) [m], (W, R); `reach` where it is not within that."""
        group, geom = np.array([1, 0, 0, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
        found = [
            mujoco.mj_ray(*self._scene, point, [0.0, 0.0, -1.0], group, 1, -1, geom)
            for point in points.flatten(0, 1).numpy()
        ]
        distance = torch.tensor(found, dtype=torch.float64).view(points.shape[:2])
        return distance.where((distance >= 0.0) & (distance < reach), torch.full_like(distance, reach))


def _worlds(model: mujoco.MjModel, qpos: Tensor, qvel: Tensor) -> Iterator[mujoco.MjData]:
    """One MjData, filled for each world in turn."""
    data = mujoco.MjData(model)
    for position, velocity in zip(qpos, qvel, strict=True):
        data.qpos[:], data.qvel[:] = position.numpy(), velocity.numpy()
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        yield data
