"""A cylinder that stands almost upright on a plane, against float64 central differences of C MuJoCo."""

import warnings

import mujoco
import numpy as np
import pytest
from oracle import Point, differences, relative, simulate, tighten

from msk_ray.step import TapePerSubstep
from msk_ray.step.forward import Kernels, WorldBatch

AZIMUTHS = np.arange(8) * np.pi / 4 + 0.3


def can(cone: str = "elliptic", euler: str = "0 0 0", margin: float = 0.0) -> mujoco.MjModel:
    return tighten(
        mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep=".002" cone="{cone}"/><default><geom margin="{margin}"/></default><worldbody>
            <geom name="floor" type="plane" size="2 2 .1" euler="{euler}"/>
            <body><freejoint/><geom name="can" type="cylinder" size=".04 .1" density="1000"/></body>
            </worldbody></mujoco>"""
        )
    )


def standing(model: mujoco.MjModel, tilt: float, azimuth: float, depth: float, speed: float = 0.0) -> Point:
    """A can whose cap's middle is below the plane by `depth`."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    plane, turn, yaw = np.zeros(4), np.zeros(4), np.zeros(4)
    mujoco.mju_mat2Quat(plane, data.geom_xmat[0])
    mujoco.mju_axisAngle2Quat(turn, np.array([np.cos(azimuth), np.sin(azimuth), 0]), tilt)
    mujoco.mju_axisAngle2Quat(yaw, np.array([0, 0, 1.0]), 0.7)
    qpos = np.zeros(7)
    mujoco.mju_mulQuat(turn, turn, yaw)
    mujoco.mju_mulQuat(qpos[3:], plane, turn)
    qpos[:3] = data.geom_xmat[0].reshape(3, 3) @ [0, 0, 0.1 * np.cos(tilt) - depth]
    qvel = speed * np.random.default_rng(int(1e3 * azimuth)).normal(size=6)
    return Point(*(np.asarray(v, np.float32).astype(float) for v in (qpos, qvel, [], [])))


def errors(model: mujoco.MjModel, points: list[Point], steps: list[float]) -> tuple[list[float], float]:
    """Relative errors of the gradients to qpos and qvel, by differences of these steps, and the share approximated."""
    rng = np.random.default_rng(0)
    weights = {n: rng.normal(size=(len(points), model.nv)).astype(np.float32).astype(float) for n in ("qpos", "qvel")}
    weights["act"] = np.zeros((len(points), 0))
    _, found, sim = simulate(model, TapePerSubstep(), points, 1, weights)
    out = []
    for i, (point, step) in enumerate(zip(points, steps, strict=True)):
        expected, _ = differences(model, point, 1, {n: w[i] for n, w in weights.items()}, step)
        out.append(max(relative(found[n][i], expected[n]) for n in ("qpos", "qvel")))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return out, sim.diagnostics()["approximated_share"]


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_an_almost_upright_can_is_exact(cone: str, speed: float) -> None:
    model = can(cone)
    tilts = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5)
    points = [standing(model, tilt, azimuth, 1.5e-4, speed) for tilt in tilts for azimuth in AZIMUTHS]
    found, share = errors(model, points, [min(1e-6, 2e-3 * tilt) for tilt in tilts for _ in AZIMUTHS])
    assert max(found) < 2e-3
    assert np.median(found) < 1e-4
    assert share == 0.0


def test_on_a_slope_it_is_as_exact_as_float32_knows_the_tilt() -> None:
    model = can(euler="10 20 0")
    for tilt in (3e-3, 3e-4, 3e-5):
        points = [standing(model, tilt, azimuth, 2e-4) for azimuth in AZIMUTHS]
        found, _ = errors(model, points, [1e-7] * len(points))
        assert max(found) < 1e-4 + 3e-7 / tilt


def test_an_upright_can_counts_as_approximated() -> None:
    model = can()
    points = [standing(model, tilt, azimuth, 2e-4) for tilt in (0.0, 1e-6) for azimuth in AZIMUTHS]
    found, share = errors(model, points, [1e-7] * len(points))
    assert max(found) < 1e-2
    assert share == 1.0


@pytest.mark.parametrize("tilt", [3e-2, 1e-3, 0.0])
def test_a_can_on_a_box_counts_as_approximated(tilt: float) -> None:
    """C MuJoCo clips its rim as a polygon, whose corners jump: there is no derivative to compare with."""
    model = can()
    model.geom_type[0], model.geom_size[0], model.geom_pos[0, 2] = mujoco.mjtGeom.mjGEOM_BOX, (2, 2, 0.1), -0.1
    points = [standing(model, tilt, azimuth, 1.5e-4) for azimuth in AZIMUTHS]
    _, share = errors(model, points, [1e-6] * len(points))
    assert share == 1.0


@pytest.mark.parametrize("euler", ["0 0 0", "10 20 0"])
@pytest.mark.parametrize("ordered", [False, True])
def test_contacts_are_those_of_c_mujoco(euler: str, ordered: bool) -> None:
    """Also where mujoco_warp finds fewer: the plane is close to each of the contacts, and the tilt is small."""
    model = can(euler=euler, margin=1e-3)
    tilts = 10.0 ** np.random.default_rng(0).uniform(-6, -2, 256)
    depths = [0.5 * 0.04 * np.sin(tilt) - 2e-3 + 2e-6 for tilt in tilts]
    points = [standing(model, tilt, 0.1 * i, depth) for i, (tilt, depth) in enumerate(zip(tilts, depths, strict=True))]
    batch = WorldBatch(model, len(points), 1, "cpu", kernels=Kernels(ordered=ordered))
    batch.data.qpos.assign(np.array([p.qpos for p in points]))
    batch.launch_step()
    count = int(batch.data.nacon.numpy()[0])
    contact = {n: getattr(batch.data.contact, n).numpy()[:count] for n in ("worldid", "dist", "pos", "efc_address")}
    data = mujoco.MjData(model)
    for world, point in enumerate(points):
        data.qpos[:] = point.qpos
        mujoco.mj_forward(model, data)
        own = contact["worldid"] == world
        expected = np.array(sorted((c.dist, *c.pos) for c in data.contact))
        found = np.column_stack([contact["dist"], contact["pos"]])[own]
        inside = found[:, 0] < 2e-3
        found = found[inside][np.lexsort(found[inside].T[::-1])]
        assert len(found) == len(expected), tilts[world]
        assert np.abs(found[:, 0] - expected[:, 0]).max() < 1e-7
