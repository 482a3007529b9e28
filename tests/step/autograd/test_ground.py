"""Rays onto the ground, against C MuJoCo and its central differences."""

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.step.autograd.ground import Ground, grid
from msk_ray.step.autograd.kinematics import Kinematics
from msk_ray.step.errors import UnsupportedModelError
from msk_ray.step.forward import WorldBatch

WORLDS, REACH = 3, 2.0
MODEL = """<mujoco><asset><hfield name="hills" nrow="7" ncol="9" size="2 2 .6 .1"/></asset><worldbody>
<geom name="hills" type="hfield" hfield="hills" pos="2 0 0" rgba="0 0 0 0"/>
<body pos="-1 0 0" euler="0 20 0"><geom type="box" size=".6 1 .3"/></body>
<geom type="plane" size="0 0 1" pos="0 0 -.5" euler="3 0 0"/>
<geom name="sign" type="box" size="3 3 .01" pos="0 0 .7" contype="0" conaffinity="0"/>
<body name="robot" pos="0 0 1"><freejoint/><geom type="box" size=".3 .2 .1" group="3" mass="1"/>
  <geom size=".1" pos="0 0 -.3" group="3"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.hfield_data[:] = np.random.default_rng(4).uniform(size=model.hfield_data.size)
    return model


def exact(model: mujoco.MjModel, qpos: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """The scan by mj_ray, which sees neither the sign nor the robot."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    heading = data.body("robot").xmat.reshape(3, 3)[:2, 0]
    heading /= np.linalg.norm(heading)
    shown = model.geom_rgba.copy()
    model.geom_rgba[:, 3] = [g != model.geom("sign").id for g in range(model.ngeom)]
    found = []
    for ahead, left in offsets:
        start = data.body("robot").xpos.copy()
        start[:2] += ahead * heading + left * np.array([-heading[1], heading[0]])
        groups = np.array([1, 1, 1, 0, 1, 1], dtype=np.uint8)
        distance = mujoco.mj_ray(model, data, start, [0.0, 0.0, -1.0], groups, 1, -1, np.zeros(1, np.int32))
        found.append(distance if 0.0 <= distance < REACH else REACH)
    model.geom_rgba[:] = shown
    return np.array(found)


def test_a_scan_and_its_gradient(model: mujoco.MjModel) -> None:
    """Above the plane, a tilted box and a height field; level, turned, and too high for some rays."""
    batch = WorldBatch(model, WORLDS, 1, "cpu")
    ground, kinematics = Ground(batch), Kinematics(batch)
    offsets = grid(3.0, 0.5, 0.5)
    assert offsets.shape == (14, 2)
    assert offsets[:2].tolist() == [[-1.5, -0.25], [-1.0, -0.25]]
    qpos = np.tile(model.qpos0, (WORLDS, 1))
    qpos[:, :3] = [[0.03, 0.04, 1.0], [0.1, -0.2, 1.1], [0.2, 0.3, 1.8]]
    for row, turn in zip(qpos, ([0.0, 0.0, 0.0], [0.3, -0.4, 0.5], [0.1, 0.2, 2.0]), strict=True):
        mujoco.mj_integratePos(model, row, np.array([0.0, 0.0, 0.0, *turn]), 1.0)
    q = torch.tensor(qpos, dtype=torch.float32, requires_grad=True)
    found = ground.scan(kinematics(q, torch.zeros(WORLDS, model.nv)), "robot", offsets, REACH)
    expected = np.stack([exact(model, row, offsets.numpy()) for row in qpos])
    np.testing.assert_allclose(found.detach(), expected, atol=1e-5)
    assert (expected == REACH).any()
    assert (expected < 1.0).any()
    weights = np.random.default_rng(3).normal(size=expected.shape)
    (gradient,) = torch.autograd.grad((found * torch.tensor(weights, dtype=torch.float32)).sum(), q)
    eps = 1e-6
    for w in range(WORLDS):
        slopes, tangent = np.zeros(model.nv), np.zeros(model.nv)
        for i, direction in enumerate(np.eye(model.nv)):
            ends = []
            for sign in (eps, -eps):
                moved = qpos[w].copy()
                mujoco.mj_integratePos(model, moved, direction, sign)
                ends.append((moved, exact(model, moved, offsets.numpy()) @ weights[w]))
            slopes[i] = (ends[0][1] - ends[1][1]) / (2 * eps)
            tangent[i] = gradient[w].double().numpy() @ (ends[0][0] - ends[1][0]) / (2 * eps)
        assert np.abs(slopes).max() > 0.1
        np.testing.assert_allclose(tangent, slopes, atol=1e-4 * np.abs(slopes).max())


SHAPES = """<mujoco><asset><mesh name="wedge" vertex="-1 -1 -.4  1 -1 -.4  -1 1 -.4  1 1 -.4  -1 0 .4  1 0 .4"/></asset>
<worldbody><geom type="plane" size="1.5 1 1" pos="0 0 -.6"/><geom type="plane" size="0 0 1" pos="0 0 -.9"/>
<geom type="sphere" size=".5" pos="-3 0 0"/><geom type="capsule" size=".3 .5" euler="60 20 0" pos="-2 2 0"/>
<geom type="ellipsoid" size=".3 .5 .4" euler="30 0 40" pos="2 1 0"/>
<geom type="cylinder" size=".3 .6" euler="70 10 0" pos="-2 -2 0"/>
<geom type="mesh" mesh="wedge" euler="10 20 30" pos="2 -2 0"/><geom type="box" size=".5 .4 .3" euler="0 0 40"/>
<geom type="box" size=".6 .6 .1" pos=".3 0 .8"/></worldbody></mujoco>"""


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def test_every_type_of_geom_is_met_from_above_and_from_within(device: str) -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rng = np.random.default_rng(1)
    points = rng.uniform([-4.0, -3.0, -0.5], [4.0, 3.0, 1.5], (WORLDS, 400, 3)).astype(np.float32)
    met = np.zeros(1, np.int32)
    expected, geoms = np.full(points.shape[:2], REACH), set()
    for at, point in zip(np.ndindex(*expected.shape), points.reshape(-1, 3), strict=True):
        distance = mujoco.mj_ray(model, data, point.astype(np.float64), [0.0, 0.0, -1.0], None, 1, -1, met)
        if 0.0 <= distance < REACH:
            expected[at] = distance
            geoms.add(int(met[0]))
    found = Ground(WorldBatch(model, WORLDS, 1, device)).below(torch.tensor(points, device=device), REACH)
    np.testing.assert_allclose(found.cpu(), expected, atol=1e-5)
    assert geoms == set(range(model.ngeom))
    assert (expected == REACH).any()


def test_a_geom_is_as_large_as_its_world_says() -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    batch = WorldBatch(model, 2, 1, "cpu").with_parameters(["geom_size"])
    points = torch.tensor([[-3.0, 0.7, 1.0]]).expand(2, 1, 3)
    sizes = np.tile(model.geom_size.astype(np.float32), (2, 1, 1))
    sizes[1, 2] = 1.0
    batch.model.geom_size.assign(sizes)
    assert Ground(batch).below(points, 3.0).flatten().tolist() == pytest.approx([1.9, 1.0 - 0.51**0.5], abs=1e-5)


def test_a_model_without_ground_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    ground = Ground(WorldBatch(model, 1, 1, "cpu"))
    with pytest.raises(UnsupportedModelError, match="the model has no ground: no geom is fixed to the world"):
        ground.below(torch.zeros(1, 1, 3), 1.0)
