"""The 26-muscle model: layout, mirror, moment arms, fibre ranges, keyframes, ground."""

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.config import PhysicsConfig
from msk_ray.legs.myoleg26 import tables
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.env import MyoLeg26
from msk_ray.legs.myoleg26.model import CURVE, WINDOW, build_myoleg26
from msk_ray.legs.myoleg26.moment_arms import PUBLISHED, moment_arms
from msk_ray.legs.myoleg26.terrain import Terrain
from msk_ray.step import Simulation
from msk_ray.step.adjoint.coverage.check import check_supported

MIRROR = np.array([1, 1, -1, 1, -1, -1], dtype=float)
"""Pelvis coordinates in a mirror at its plane of symmetry."""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_myoleg26(MyoLeg26Settings(name="myoleg26"), PhysicsConfig())


def fibre_lengths(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    prm, ranges = model.actuator_gainprm, model.actuator_lengthrange
    optimum = (ranges[:, 1] - ranges[:, 0]) / (prm[:, 1] - prm[:, 0])
    return prm[:, 0] + (data.actuator_length - ranges[:, 0]) / optimum


def test_layout(model: mujoco.MjModel) -> None:
    assert (model.nq, model.nv, model.nu, model.na, model.neq) == (18, 18, 26, 26, 0)
    assert model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
    assert model.body_subtreemass[0] == pytest.approx(75.165, abs=1e-3)
    assert [model.joint(i).name for i in range(6)] == [name for name, _, _ in tables.ROOT]
    assert [model.joint(i).name for i in (6, 9, 12, 15)] == [
        "hip_flexion_r",
        "knee_angle_r",
        "hip_flexion_l",
        "knee_angle_l",
    ]
    assert [model.actuator(i).name for i in (0, 12, 13, 25)] == ["abd_r", "fdl_r", "abd_l", "fdl_l"]
    touching = {int(g) for g in np.concatenate((model.pair_geom1, model.pair_geom2))}
    assert not any(model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH for g in touching)
    assert np.all(model.actuator_dynprm[:, 2] > 0), "a hard switch of time constants has no slope"


def test_its_own_limit_of_iterations_is_kept(model: mujoco.MjModel) -> None:
    assert MyoLeg26.solver_limits(model, PhysicsConfig()) == {"iterations": 20, "ls_iterations": 50}


def test_the_left_side_mirrors_the_right(model: mujoco.MjModel) -> None:
    rng = np.random.default_rng(0)
    one, other = mujoco.MjData(model), mujoco.MjData(model)
    for data in (one, other):
        mujoco.mj_resetDataKeyframe(model, data, model.key("walk_right").id)
    one.qpos[3:6] = 0.2 * rng.normal(size=3)
    one.qvel[:] += rng.normal(size=model.nv)
    one.act[:] = rng.uniform(size=26)
    for part in ("qpos", "qvel"):
        source = getattr(one, part)
        getattr(other, part)[:] = np.concatenate((MIRROR * source[:6], source[12:], source[6:12]))
    other.act[:] = np.concatenate((one.act[13:], one.act[:13]))
    for data in (one, other):
        mujoco.mj_forward(model, data)
    mirrored = np.concatenate((MIRROR * one.qacc[:6], one.qacc[12:], one.qacc[6:12]))
    np.testing.assert_allclose(other.qacc, mirrored, rtol=1e-6, atol=1e-6)


def test_every_muscle_stays_inside_its_force_length_range(model: mujoco.MjModel) -> None:
    """Fault: rigid tendons with published fibre lengths leave the curve, with no force and no gradient."""
    rng = np.random.default_rng(1)
    data = mujoco.MjData(model)
    low, high = model.jnt_range[6:].T
    found = []
    corners = rng.integers(0, 2, size=(500, 12))
    for share in (*rng.uniform(size=(1500, 12)), *corners):
        data.qpos[6:] = low + share * (high - low)
        mujoco.mj_fwdPosition(model, data)
        found.append(fibre_lengths(model, data))
    lengths = np.array(found)
    slack = 0.01  # a ninth of each range is not sampled when the fibres are fitted
    assert lengths.min() > WINDOW[0] - slack
    assert lengths.max() < WINDOW[1] + slack
    assert CURVE[0] < WINDOW[0] < WINDOW[1] < CURVE[1]
    prm = model.actuator_gainprm[0, :9].copy()
    ends = [
        mujoco.mju_muscleGain(length, 0.0, np.array(WINDOW), 1.0, np.array([*WINDOW, 1.0, *prm[3:9]]))
        for length in WINDOW
    ]
    assert max(ends) < -0.17, "hardly any force at an end of the window"


def test_fibres_keep_the_published_lengths_and_forces_where_they_can(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    lengths = fibre_lengths(model, data)
    for muscle in tables.MUSCLES:
        i = model.actuator(f"{muscle.name}_r").id
        assert lengths[i] == pytest.approx(tables.FIBRE_REFERENCE[muscle.name], abs=0.0501)
        assert model.actuator_gainprm[i, 2] == pytest.approx(muscle.force * np.cos(muscle.pennation))
        ranges, prm = model.actuator_lengthrange[i], model.actuator_gainprm[i]
        optimum = (ranges[1] - ranges[0]) / (prm[1] - prm[0])
        assert optimum >= muscle.fibre * (1 - 1e-9)
        assert optimum * prm[6] == pytest.approx(muscle.fibre * muscle.speed), "largest speed in m/s"


@pytest.mark.parametrize("entry", PUBLISHED, ids=lambda e: f"{e.muscle}-{e.joint}")
def test_moment_arms_lie_in_the_published_ranges(model: mujoco.MjModel, entry) -> None:
    angles = np.linspace(*np.deg2rad(entry.angles), 9)
    arms = moment_arms(model, entry.muscle, entry.joint, angles)
    assert arms.min() >= entry.least, f"{entry.source}: {arms}"
    assert arms.max() <= entry.most, f"{entry.source}: {arms}"


@pytest.mark.parametrize("entry", PUBLISHED, ids=lambda e: f"{e.muscle}-{e.joint}")
def test_no_muscle_changes_its_mind_over_a_joint_range(model: mujoco.MjModel, entry) -> None:
    low, high = model.joint(f"{entry.joint}_r").range
    arms = moment_arms(model, entry.muscle, entry.joint, np.linspace(low + 1e-3, high - 1e-3, 25))
    assert np.all(arms * np.sign(entry.most + entry.least) > 0.0)


@pytest.mark.parametrize("name", ["stand", "walk_left", "walk_right"])
def test_keyframes_satisfy_every_constraint(model: mujoco.MjModel, name: str) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(name).id)
    mujoco.mj_forward(model, data)
    low, high = model.jnt_range[6:].T
    assert np.all(data.qpos[6:] >= low)
    assert np.all(data.qpos[6:] <= high)
    assert data.contact.dist[: data.ncon].min() == pytest.approx(-5e-4, abs=1e-5)
    soles = [{model.geom(int(g)).name[-1] for g in pair} for pair in data.contact.geom[: data.ncon]]
    assert {"r", "l"} <= set().union(*soles), "both feet touch"
    height = data.subtree_com[0, 2]
    assert 0.9 < height < 1.1
    if name == "stand":
        feet = [data.geom_xpos[model.geom(f"sole_{part}_r").id, 0] for part in ("calcn0", "calcn1")]
        assert feet[0] + 0.02 < data.subtree_com[0, 0] < feet[1] - 0.02, "the centre of mass is over the feet"
    else:
        ahead = data.xpos[model.body(f"talus_{name[5]}").id, 0]
        behind = data.xpos[model.body("talus_r" if name[5] == "l" else "talus_l").id, 0]
        assert ahead - behind > 0.4
        for k in range(data.ncon):
            body = int(model.geom_bodyid[data.contact.geom[k].max()])
            jacobian = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, data.contact.pos[k], body)
            if model.body(body).name.startswith(("calcn", "toes")) and data.contact.dist[k] < -4e-4:
                assert np.linalg.norm(jacobian @ data.qvel) < 0.25, "the foot in contact is nearly at rest"


def test_a_spring_straightens_bent_toes() -> None:
    """In free fall, 0.2 s after push-off; without it they are where push-off left them."""
    angles = []
    for stiffness in (0.0, 25.0):
        model = build_myoleg26(MyoLeg26Settings(name="myoleg26", toe_stiffness=stiffness), PhysicsConfig())
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
        data.joint("pelvis_ty").qpos += 1.0
        data.joint("mtp_angle_r").qpos = 0.6
        for _ in range(50):
            mujoco.mj_step(model, data)
        angles.append(float(data.joint("mtp_angle_r").qpos[0]))
    free, sprung = angles
    assert free > 0.5
    assert abs(sprung) < 0.1


def test_it_stays_bounded_under_any_constant_excitation(model: mujoco.MjModel) -> None:
    for excitation in (0.0, 0.3, 1.0):
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.ctrl[:] = excitation
        for _ in range(250):
            mujoco.mj_step(model, data)
            assert np.abs(data.qvel).max() < 60.0
        assert not np.any([w.number for w in data.warning])


@pytest.mark.parametrize("kind", ["slope", "steps", "rough"])
def test_ground_from_primitives_is_differentiable_and_where_it_says(kind: str) -> None:
    config = MyoLeg26Settings.model_validate({"name": "myoleg26", "terrain": {"kind": kind}})
    model = build_myoleg26(config, PhysicsConfig())
    check_supported(model, "tape_per_substep")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    terrain = Terrain(config.terrain)
    for x in (0.1, 1.0, 1.6, 3.3):
        group = np.ones(6, dtype=np.uint8)
        geom = np.zeros(1, dtype=np.int32)
        start = np.array([x, 2.0, 3.0])
        drop = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), group, 1, -1, geom)
        expected = terrain.slope * x if kind == "slope" else terrain.levels[np.searchsorted(terrain.edges, x)]
        assert 3.0 - drop == pytest.approx(expected, abs=1e-6)
        assert model.geom(int(geom[0])).name.startswith("floor")


@pytest.mark.parametrize("mode", ["tape_per_substep", "fd_jacobian"])
def test_a_height_field_is_differentiated(mode: str) -> None:
    config = MyoLeg26Settings.model_validate({"name": "myoleg26", "terrain": {"kind": "height_field"}})
    model = build_myoleg26(config, PhysicsConfig())
    sim = Simulation(model, 1, 1, mode, "cpu")
    key = model.key("stand")
    qpos, qvel, act = (torch.tensor(v[None], dtype=torch.float32) for v in (key.qpos, key.qvel, key.act))
    ctrl = torch.full((1, 26), 0.1, requires_grad=True)
    end = sim.step(ctrl, qpos, qvel, act.requires_grad_())
    end.qvel.square().sum().backward()
    assert act.grad is not None
    assert act.grad.isfinite().all()
    assert act.grad.abs().max() > 0
