"""Rough ground: a grid of patches, which get harder from row to row. Source: `mjlab/terrains` of mjlab 1.6.0.

Axes: R rows, K kinds of patches. Lengths are in m.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

_SIDE = 8.0
"""Side of a patch."""
_BORDER = 40.0
"""Width of the flat ground around all patches, which no robot crosses in an episode."""
_DEPTH = 1.0
"""Thickness of the ground, so that nothing slips through between its parts."""
_STAIRS, _STEP, _PLATFORM = 6.0, 0.3, 3.0
"""Side of the stairs, depth of a step, and side of the platform."""
_HIGHEST_STEP = 0.1
"""Height of a step in the hardest row."""
_CELLS = 80
"""Points of a height field along each side."""
_EDGE = 2
"""Points at each edge of a height field that are level."""
_SPACING = 0.1
"""Distance between the points of a height field."""
_UNIT = 0.005
"""Heights of height fields are whole multiples of it."""
_SLOPE = 1.0
"""Steepest slope, rise over run, towards a platform of 2 m."""
_NOISE = (0.02, 0.10)
"""Smallest and largest random height."""
_NOISE_STEP = 0.02
"""Random heights are multiples of it."""
_WAVE = 0.2
"""Height of the waves in the hardest row, from the lowest point to the crest along one axis."""
_WAVES = 4
"""Number of waves along each axis."""
_FOOTPRINT = 8
"""Points from the middle of a patch within which a robot stands that begins there."""
_SEED = 0
"""Seed of the random heights."""


class Box(NamedTuple):
    """A box of ground: centre and half sides along x and y, and the height of its top."""

    x: float
    y: float
    half_x: float
    half_y: float
    top: float


class Patch(NamedTuple):
    """What a patch is made of, around its middle."""

    start: float
    """Height of the ground on which robots begin."""
    boxes: tuple[Box, ...] = ()
    heights: NDArray[np.float64] | None = None
    """Heights of the points of a height field, (rows along y, columns along x); None: boxes alone."""


Generate = Callable[[float, np.random.Generator], Patch]


def flat(difficulty: float, rng: np.random.Generator) -> Patch:
    """Level ground."""
    return Patch(0.0, (Box(0.0, 0.0, _SIDE / 2.0, _SIDE / 2.0, 0.0),))


def stairs_up(difficulty: float, rng: np.random.Generator) -> Patch:
    """A pyramid of steps of up to 0.1 m, with its platform on top."""
    return _stairs(difficulty * _HIGHEST_STEP)


def stairs_down(difficulty: float, rng: np.random.Generator) -> Patch:
    """The stairs upside down: robots begin at the bottom."""
    return _stairs(-difficulty * _HIGHEST_STEP)


def slope_up(difficulty: float, rng: np.random.Generator) -> Patch:
    """A pyramid of slopes of up to 45°, with its platform on top."""
    return _slope(difficulty * _SLOPE)


def slope_down(difficulty: float, rng: np.random.Generator) -> Patch:
    """The slopes upside down: robots begin at the bottom."""
    return _slope(-difficulty * _SLOPE)


def noise(difficulty: float, rng: np.random.Generator) -> Patch:
    """Random heights of 0.02 to 0.1 m, equally rough in all rows."""
    low, high, step = (round(value / _UNIT) for value in (*_NOISE, _NOISE_STEP))
    return _field(rng.choice(np.arange(low, high + step, step), size=2 * (_CELLS - 2 * _EDGE,)))


def waves(difficulty: float, rng: np.random.Generator) -> Patch:
    """Waves of up to 0.2 m along both axes."""
    phase = 2.0 * math.pi * _WAVES / (_CELLS - 2 * _EDGE) * np.arange(_CELLS - 2 * _EDGE)
    amplitude = int(0.5 * difficulty * _WAVE / _UNIT)
    return _field(amplitude * (np.sin(phase)[:, None] + np.cos(phase)))


KINDS: Final[dict[Generate, float]] = {
    flat: 0.2,
    stairs_up: 0.2,
    stairs_down: 0.2,
    slope_up: 0.1,
    slope_down: 0.1,
    noise: 0.1,
    waves: 0.1,
}
"""The kinds of patches with the shares of the episodes that begin on them."""


class Terrain:
    """R × K patches around the origin: they get harder along x, and along y the kind changes.

    Args:
        rows: number of rows R, at least 2.

    Attributes:
        starts: where robots begin, (R, K, 3).
    """

    def __init__(self, rows: int) -> None:
        self._size = np.array([rows, len(KINDS)]) * _SIDE
        rng = np.random.default_rng(_SEED)
        self._patches: list[tuple[NDArray[np.float64], Patch]] = []
        self.starts = np.zeros((rows, len(KINDS), 3))
        for column, generate in enumerate(KINDS):
            for row in range(rows):
                middle = (np.array([row, column]) + 0.5) * _SIDE - self._size / 2.0
                patch = generate(row / (rows - 1), rng)
                self._patches.append((middle, patch))
                self.starts[row, column] = *middle, patch.start

    def add_to(self, spec: mujoco.MjSpec, body: str) -> None:
        """Replace the geoms of a body of the model by the patches."""
        ground = spec.body(body)
        for geom in list(ground.geoms):
            spec.delete(geom)
        size = self._size
        border = (Box(*box, 0.0) for box in _ring(size + 2.0 * _BORDER, size))
        boxes = [(np.zeros(2), box) for box in border]
        boxes += [(middle, box) for middle, patch in self._patches for box in patch.boxes]
        for middle, (x, y, half_x, half_y, top) in boxes:
            ground.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[middle[0] + x, middle[1] + y, top - _DEPTH / 2.0],
                size=[half_x, half_y, _DEPTH / 2.0],
                mass=0.0,
            )
        fields = ((middle, patch.heights) for middle, patch in self._patches if patch.heights is not None)
        for k, (middle, heights) in enumerate(fields):
            low, high = heights.min(), heights.max()
            spec.add_hfield(
                name=f"{body}_{k}",
                nrow=_CELLS,
                ncol=_CELLS,
                size=[_SIDE / 2.0, _SIDE / 2.0, max(high - low, _UNIT), _DEPTH],
                userdata=(heights - low).flatten().tolist(),
            )
            ground.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=f"{body}_{k}", pos=[*middle, low], mass=0.0)


def _ring(outer: NDArray[np.float64], inner: NDArray[np.float64]) -> Iterator[tuple[float, float, float, float]]:
    """Four rectangles that fill the space between two concentric ones, each as its centre and half sides.

    Args:
        outer, inner: sides of the concentric rectangles along x and y, (2,).
    """
    (width, height), (thick_x, thick_y) = outer / 2.0, (outer - inner) / 4.0
    for side in (1.0, -1.0):
        yield 0.0, side * (height - thick_y), width, thick_y
    for side in (1.0, -1.0):
        yield side * (width - thick_x), 0.0, thick_x, height - 2.0 * thick_y


def _stairs(rise: float) -> Patch:
    """Steps that rise, or fall, towards the middle."""
    steps = round((_STAIRS - _PLATFORM) / (2.0 * _STEP))
    sides = np.array([_SIDE, *(_STAIRS - 2.0 * _STEP * np.arange(steps + 1))])
    boxes = [
        Box(*box, rise * k)
        for k, (outer, inner) in enumerate(itertools.pairwise(sides))
        for box in _ring(np.full(2, outer), np.full(2, inner))
    ]
    top = rise * (steps + 1)
    return Patch(top, (*boxes, Box(0.0, 0.0, _PLATFORM / 2.0, _PLATFORM / 2.0, top)))


def _slope(slope: float) -> Patch:
    """Ground that rises, or falls, towards a platform in the middle."""
    inner = _CELLS - 2 * _EDGE
    share = 1.0 - np.abs(1.0 - np.arange(inner) / (inner // 2))
    highest = int(slope * (inner * _SPACING) / 2.0 / _UNIT)
    heights = highest * share[:, None] * share
    platform = heights[inner // 2 - 10, inner // 2 - 10]
    return _field(heights.clip(min(0.0, platform), max(0.0, platform)))


def _field(units: NDArray[np.floating]) -> Patch:
    """A height field with a level edge, from heights in multiples of 5 mm."""
    heights = np.pad(np.rint(units) * _UNIT, _EDGE)
    near = slice(_CELLS // 2 - _FOOTPRINT, _CELLS // 2 + _FOOTPRINT)
    return Patch(float(heights[near, near].max()), heights=heights)
