"""Rough ground against that of unmodified mjlab 1.6.0, as `tests/fixtures/mjlab/record.py` has recorded it."""

from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from msk_ray.robots.terrain import KINDS, Terrain, noise
from msk_ray.step.autograd.ground import Ground
from msk_ray.step.forward import WorldBatch

GROUND = Path(__file__).parents[1] / "fixtures" / "mjlab" / "ground.npz"
ROWS = 4
UNIT = 0.005
"""Heights of height fields are multiples of it [m]."""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body name='terrain'><geom size='1'/></body></worldbody></mujoco>"
    )
    Terrain(ROWS).add_to(spec, "terrain")
    return spec.compile()


def heights_of(model: mujoco.MjModel) -> Iterator[tuple[NDArray[np.floating], NDArray[np.floating]]]:
    """Middle and heights of each height field."""
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD):
        field = model.hfield(model.geom_dataid[geom])
        yield model.geom_pos[geom, :2], model.geom_pos[geom, 2] + field.size[2] * field.data


def test_boxes_have_mjlabs_tops(model: mujoco.MjModel) -> None:
    boxes = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    ours = tops(model.geom_pos[boxes], model.geom_size[boxes])
    with np.load(GROUND) as recorded:
        theirs = tops(recorded["box_position"], recorded["box_size"])
    assert ours.shape == theirs.shape == (ROWS * (1 + 2 * 25), 5)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


def tops(position: NDArray[np.floating], size: NDArray[np.floating]) -> NDArray[np.floating]:
    """Centre, half sides and height of the tops, sorted, without the border's."""
    found = np.column_stack((position[:, :2], size[:, :2], position[:, 2] + size[:, 2]))
    within = found[np.abs(found[:, 0]) < ROWS * 4.0]
    within = within[np.abs(within[:, 1]) < len(KINDS) * 4.0]
    return within[np.lexsort(np.round(within.T, 3))]


def test_height_fields_are_mjlabs(model: mujoco.MjModel) -> None:
    random = list(KINDS).index(noise)
    with np.load(GROUND) as recorded:
        theirs = {
            tuple(np.round(position[:2], 3)): position[2] + heights.astype(np.float32)
            for position, heights in zip(recorded["field_position"], recorded["field_heights"], strict=True)
        }
        of_noise = {tuple(np.round(origin[:2], 3)) for origin in recorded["origins"][:, random]}
    ours = {tuple(np.round(middle, 3)): heights for middle, heights in heights_of(model)}
    assert ours.keys() == theirs.keys()
    for place in ours:
        if place in of_noise:
            for heights in (ours[place], theirs[place]):
                assert heights[:2].max() == pytest.approx(0.0, abs=1e-6)
                assert heights[2:-2, 2:-2].mean() == pytest.approx(0.06, abs=UNIT)
                assert heights[2:-2, 2:-2].std() == pytest.approx(0.028, abs=UNIT)
        else:
            np.testing.assert_allclose(ours[place], theirs[place], atol=1.01 * UNIT)
            same = np.abs(ours[place] - theirs[place]) < 1e-3
            # mjlab's slope of 0 lies one unit away from the ground.
            assert np.mean(same) > 0.9 or np.ptp(theirs[place]) == 0.0, place


def test_robots_begin_on_the_ground_in_the_middle_of_patches(model: mujoco.MjModel) -> None:
    starts = Terrain(ROWS).starts
    with np.load(GROUND) as recorded:
        np.testing.assert_allclose(starts[..., :2], recorded["origins"][..., :2], atol=1e-5)
        # Where mjlab's could begin in the ground, these begin above it.
        assert np.all(starts[..., 2] > recorded["origins"][..., 2] - 1.01 * UNIT)
        level = [k for k, kind in enumerate(KINDS) if kind.__name__.startswith(("flat", "stairs", "slope"))]
        np.testing.assert_allclose(starts[:, level, 2], recorded["origins"][:, level, 2], atol=1.01 * UNIT)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for start in starts.reshape(-1, 3):
        foot, down = start + np.array([0.3, -0.2, 1.0]), np.array([0.0, 0.0, -1.0])
        above = mujoco.mj_ray(model, data, foot, down, None, 1, -1, np.zeros(1, np.int32))
        assert 1.0 - 1e-3 <= above < 1.5


def test_rays_meet_the_ground_where_those_of_c_mujoco_do(model: mujoco.MjModel) -> None:
    """Over all patches, their borders and the ground around; 1 mm beside the edges of stairs; high above; within."""
    rng, reach = np.random.default_rng(2), 3.0
    starts = Terrain(ROWS).starts.reshape(-1, 3)
    within = starts[:, None] + rng.uniform([-4.2, -4.2, -0.3], [4.2, 4.2, 1.0], (len(starts), 20, 3))
    # The edges of the steps, 0.3 m apart, along both axes from the middles of patches.
    edges = 1.5 + 0.3 * np.repeat(np.arange(6), 2) + np.tile([-1e-3, 1e-3], 6)
    offset = np.concatenate([np.column_stack(pair) for pair in ((edges, 0 * edges + 0.1), (0 * edges + 0.1, -edges))])
    beside = starts[:, None] + np.pad(offset, ((0, 0), (0, 1)), constant_values=1.0)
    around = rng.uniform([-80.0, -80.0, 0.1], [80.0, 80.0, 4.0], (200, 3))
    points = np.concatenate([part.reshape(-1, 3) for part in (within, beside, around)]).astype(np.float32)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geom, down = np.zeros(1, np.int32), np.array([0.0, 0.0, -1.0])
    expected = np.array([mujoco.mj_ray(model, data, p.astype(float), down, None, 1, -1, geom) for p in points])
    expected[(expected < 0.0) | (expected >= reach)] = reach
    found = Ground(WorldBatch(model, 1, 1, "cpu")).below(torch.tensor(points)[None], reach)[0]
    np.testing.assert_allclose(found, expected, atol=2e-5)
    assert (expected == reach).any()
