"""Ground from primitives, and its height as a function of x."""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from msk_ray.legs.myoleg26.config import TerrainConfig

_PIECES = 20
"""Boxes of stepped and rough ground; with more, the number of contact pairs could no longer be bounded tightly."""
_START = 0.8
"""Position at which the flat ground ends [m]; a slope starts at the origin."""
_STEP = 0.6
"""Length along x of each step or rough strip [m]."""
_SEED = 0
"""Of the heights of rough ground."""
_HALF_WIDTH = 4.0
_DEPTH = 2.0
"""Thickness of the boxes [m]: nothing slips between or under them."""
_FIELD = (20.0, 2.0)
"""Half lengths of the height field [m]."""
_FIELD_SHAPE = (21, 201)


class Terrain:
    """The ground that a config section describes.

    Attributes:
        edges: x at which the height changes [m], ascending, shape (K,); empty for plane ground.
        levels: height [m] before, between and after the edges, shape (K + 1,).
        slope: rise over run of plane ground.
    """

    def __init__(self, config: TerrainConfig) -> None:
        self.config = config
        self.slope = config.slope if config.kind == "slope" else 0.0
        rng = np.random.default_rng(_SEED)
        self._field: NDArray[np.float64] | None = None
        self.edges: NDArray[np.floating] = np.zeros(0)
        self.levels: NDArray[np.floating] = np.zeros(1)
        strips = _START + _STEP * np.arange(_PIECES)
        if config.kind == "steps":
            self.edges, self.levels = strips, config.step_height * np.arange(_PIECES + 1)
        elif config.kind == "rough":
            self.edges = np.append(strips, strips[-1] + _STEP)
            self.levels = np.concatenate(([0.0], config.roughness * rng.uniform(size=_PIECES), [0.0]))
        elif config.kind == "height_field":
            field = rng.uniform(size=_FIELD_SHAPE)
            xs = np.linspace(-_FIELD[0], _FIELD[0], _FIELD_SHAPE[1])
            field[:, xs < _START] = 0.0
            self._field = field
            # Rows run along y; the walking line is the middle one.
            self.edges = (xs[:-1] + xs[1:]) / 2.0
            self.levels = config.roughness * field[_FIELD_SHAPE[0] // 2]

    def add_to(self, spec: mujoco.MjSpec, material: str) -> list[str]:
        """Add the ground's geoms to the world, without contacts of their own, and return their names."""
        look = {"contype": 0, "conaffinity": 0, "material": material}
        world = spec.worldbody
        names = ["floor"]
        if self._field is not None:
            spec.add_hfield(
                name="floor",
                nrow=_FIELD_SHAPE[0],
                ncol=_FIELD_SHAPE[1],
                size=[*_FIELD, max(self.config.roughness, 1e-3), _DEPTH],
                userdata=self._field.flatten().tolist(),
            )
            world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="floor", **look)
            return names
        tilt = -math.atan(self.slope) / 2.0
        world.add_geom(
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 1],
            quat=[math.cos(tilt), 0, math.sin(tilt), 0],
            **look,
        )
        for k, left in enumerate(self.edges[: _PIECES if len(self.edges) else 0]):
            right = self.edges[k + 1] if k + 1 < len(self.edges) else left + 40.0
            name = f"floor_{k}"
            world.add_geom(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[(left + right) / 2.0, 0.0, self.levels[k + 1] - _DEPTH],
                size=[(right - left) / 2.0, _HALF_WIDTH, _DEPTH],
                **look,
            )
            names.append(name)
        return names
