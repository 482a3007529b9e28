"""Rays straight down onto the ground: the geoms that are fixed to the world and can be touched.

Axes: W worlds, R rays, G geoms.
"""

import copy
from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from msk_ray.step.errors import UnsupportedModelError
from msk_ray.step.forward.mjw_private import vec6


def ground_geoms(model: mujoco.MjModel) -> list[int]:
    """Ids of the geoms of the ground.

    Raises:
        UnsupportedModelError: there are none.
    """
    paired = {*map(int, model.pair_geom1), *map(int, model.pair_geom2)}
    found = [
        g
        for g in range(model.ngeom)
        if model.body_weldid[model.geom_bodyid[g]] == 0
        and (model.geom_contype[g] or model.geom_conaffinity[g] or g in paired)
    ]
    if not found:
        raise UnsupportedModelError("the model has no ground: no geom is fixed to the world and can be touched")
    return found


class GroundRays:
    """Casts R rays in each world by `mujoco_warp.rays`.

    Args:
        mjm, model: the model and mujoco_warp's copy of it.
        nworld: number of worlds W.
        count: number of rays R.
        device: the Warp device.

    Attributes:
        origin: where the rays begin [m], vec3, (W, R).
        distance: how far below that they meet the ground [m], (W, R); -1 if they do not.
        normal: the ground's normal there, vec3, (W, R).
    """

    def __init__(self, mjm: mujoco.MjModel, model: Any, nworld: int, count: int, device: wp.Device) -> None:
        groups = np.ones(mjm.ngeom, dtype=np.int32)
        groups[ground_geoms(mjm)] = 0
        data = mujoco.MjData(mjm)
        mujoco.mj_kinematics(mjm, data)  # geoms that are fixed to the world have the same place in every state
        shape = (nworld, count)
        with wp.ScopedDevice(device):
            # Only group 0 is hit, also where a user has made it invisible.
            self._model = copy.copy(model)
            for name, array in (
                ("geom_group", wp.array(groups, dtype=int)),
                ("geom_matid", wp.full((1, mjm.ngeom), -1, dtype=int)),
                ("geom_rgba", wp.full((1, mjm.ngeom), wp.vec4(1.0), dtype=wp.vec4)),
            ):
                object.__setattr__(self._model, name, array)
            self._scene = SimpleNamespace(
                nworld=nworld,
                geom_xpos=wp.array(_tiled(data.geom_xpos, nworld), dtype=wp.vec3),
                geom_xmat=wp.array(_tiled(data.geom_xmat, nworld).reshape(nworld, -1, 3, 3), dtype=wp.mat33),
            )
            self.origin = wp.zeros(shape, dtype=wp.vec3)
            self._down = wp.full(shape, wp.vec3(0.0, 0.0, -1.0), dtype=wp.vec3)
            self._exclude = wp.full(count, -1, dtype=int)
            self.distance, self.normal = wp.zeros(shape, dtype=float), wp.zeros(shape, dtype=wp.vec3)
            self._geom = wp.zeros(shape, dtype=int)
        self._device = device

    def launch(self) -> None:
        """Launch `distance` and `normal` of `origin`."""
        with wp.ScopedDevice(self._device):
            mjw.rays(
                *(self._model, self._scene, self.origin, self._down),
                *(vec6(1, 0, 0, 0, 0, 0), True, self._exclude),
                *(self.distance, self._geom, self.normal),
            )


def _tiled(values: np.ndarray, nworld: int) -> np.ndarray:
    return np.tile(np.asarray(values, np.float32), (nworld, 1, 1))
