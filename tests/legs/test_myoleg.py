"""Installed leg models: which is taken, what is said when there is none, and gradients of what `myo_sim` ships."""

import importlib.util
from importlib.machinery import ModuleSpec
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from needs import slow
from policy_gradient import check_chain

from msk_ray.config import PhysicsConfig
from msk_ray.envs import make_env
from msk_ray.errors import ConfigError
from msk_ray.legs.gait.body import world_axes
from msk_ray.legs.myoleg.config import MyoLegSettings
from msk_ray.legs.myoleg.env import MyoLeg
from msk_ray.legs.myoleg.model import SUBSTEPS, Couplings, build_myoleg
from msk_ray.legs.myoleg.source import find_model
from msk_ray.step import Simulation, StepState, TapePerSubstep
from msk_ray.step.autograd.tangent import quat_exp, quat_multiply, quat_rotate
from msk_ray.step.check import check_gradients, make_states

pytestmark = pytest.mark.long

needs_myo_sim = pytest.mark.skipif(
    importlib.util.find_spec("myo_sim") is None, reason="myo_sim is not installed: pip install myo-sim"
)

TOY = """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body name="root" pos="0 0 .8">{root}
<geom size=".1" mass="1"/>
<body><joint name="hip_flexion_r" range="-1 1" limited="true"/><geom size=".1" mass="1"/></body>
<body><joint name="hip_flexion_l"/><joint name="coupled" axis="0 1 0"/><geom size=".1" mass="1"/></body></body>
</worldbody>
<equality><joint joint1="coupled" joint2="hip_flexion_l" polycoef="0.1 2 0.5 0 0"/></equality></mujoco>"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Pretend that only the packages installed by calling this are there, each with the given files."""
    folders: dict[str, Path] = {}

    def find_spec(name: str) -> ModuleSpec | None:
        if name not in folders:
            return None
        spec = ModuleSpec(name, None, is_package=True)
        spec.submodule_search_locations = [str(folders[name])]
        return spec

    def add(package: str, *files: str) -> None:
        folders[package] = tmp_path / package
        for file in files:
            path = folders[package] / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(TOY.format(root="<freejoint/>"))

    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    return add


def test_without_any_package_the_line_says_what_to_install(install) -> None:
    with pytest.raises(ConfigError, match=r"none of myosuite 2, myosuite 3 and myo_sim has.*pip install myo-sim"):
        find_model(None)
    with pytest.raises(ConfigError, match="myosuite3 is missing or lacks a model myolegs; install"):
        find_model("myolegs", "myosuite3")
    with pytest.raises(ConfigError, match=r"myosuite2 is missing .*`pip install --no-deps myosuite==2\.12\.2`"):
        find_model(None, "myosuite2")


def test_packages_are_tried_in_order_and_named(install) -> None:
    install("myo_sim")
    assert find_model(None).package == "myo_sim"
    install("myosuite", "envs/myo/assets/leg/myolegs_with_torso_plane.xml")
    assert find_model(None).package == "myosuite3"
    assert find_model("myolegs26").package == "myo_sim", "myosuite 3 has no 26-muscle legs"
    assert find_model(None, "myo_sim").package == "myo_sim"
    install("myosuite", "simhive/myo_sim/leg/myolegs.xml")
    found = find_model(None)
    assert found.package == "myosuite2"
    assert found.describe().startswith("myoleg: myolegs from myosuite2")
    assert found.load().compile().nq == 10


def test_a_file_of_ones_own_is_taken_before_any_package(install, tmp_path: Path) -> None:
    install("myo_sim")
    path = tmp_path / "mine.xml"
    path.write_text(TOY.format(root="<freejoint/>"))
    assert find_model(str(path)).package == "file"
    model = build_myoleg(MyoLegSettings(name="myoleg", model=str(path)), PhysicsConfig())
    assert model.opt.timestep == pytest.approx(0.002)
    stand = model.key("stand").qpos
    assert stand[2] == pytest.approx(0.1 - 5e-4, abs=1e-5), "let down until it touches"
    assert stand[-1] == pytest.approx(0.1), "the equality holds"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no file .*gone.xml; write a path, myolegs or myolegs26"),
        ("<mujoco", "MuJoCo cannot load"),
        (TOY.format(root=""), "no free joint first"),
        (TOY.format(root="<freejoint/>").replace('<geom type="plane" size="1 1 1"/>', ""), "meets no ground"),
        (
            TOY.format(root="<freejoint/>").replace(
                "<body name", '<geom name="box" type="box" size=".5 .5 .2"/><body name', 1
            ),
            "stands on geom box, which ends; remove it",
        ),
    ],
)
def test_a_file_that_does_not_fit_is_refused_on_one_line(tmp_path: Path, text: str | None, message: str) -> None:
    path = tmp_path / ("gone.xml" if text is None else "model.xml")
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        build_myoleg(MyoLegSettings(name="myoleg", model=str(path)), PhysicsConfig())
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def legs26() -> mujoco.MjModel:
    return build_myoleg(MyoLegSettings(name="myoleg", model="myolegs26", source="myo_sim"), PhysicsConfig())


@needs_myo_sim
@pytest.mark.parametrize("name", ["myolegs", *slow("myolegs26")])
@pytest.mark.parametrize("substeps", [1, *slow(8)])
def test_gradients_of_a_step(name: str, substeps: int) -> None:
    model = build_myoleg(MyoLegSettings(name="myoleg", model=name, source="myo_sim"), PhysicsConfig())
    if name == "myolegs":
        assert np.isin(model.wrap_type, int(mujoco.mjtWrap.mjWRAP_CYLINDER)).any()
    report = check_gradients(Simulation(model, 2, substeps, tolerance=1e-9), states=("standing", "policy"))
    assert report.checked >= 1
    assert report.max_rel_error <= 1e-3


@needs_myo_sim
@pytest.mark.slow  # as of myoleg26, whose model is ours
def test_gradients_through_eight_control_steps(legs26: mujoco.MjModel) -> None:
    points = [*make_states(legs26, "standing", 1, 0), *make_states(legs26, "policy", 4, 0)[:1]]
    for result in check_chain(legs26, TapePerSubstep(), points, (8,), substeps=SUBSTEPS):
        assert result.rel_error <= 1e-3


@needs_myo_sim
def test_forward_agrees_with_c_mujoco_over_100_steps(legs26: mujoco.MjModel) -> None:
    sim = Simulation(legs26, 1, 1, None, "cpu", tolerance=1e-9)
    data = mujoco.MjData(legs26)
    mujoco.mj_resetDataKeyframe(legs26, data, 0)
    data.ctrl[:] = 0.1
    state = [torch.tensor(part[None], dtype=torch.float32) for part in (data.qpos, data.qvel, data.act)]
    for _ in range(100):
        mujoco.mj_step(legs26, data)
        state = sim.step(torch.full((1, legs26.nu), 0.1), *state)
    for found, exact in zip(state, (data.qpos, data.qvel, data.act), strict=True):
        assert np.linalg.norm(found[0].numpy() - exact) <= 1e-3 * np.linalg.norm(exact)


@needs_myo_sim
def test_environment_resets_walks_and_measures_as_its_body_does(legs26: mujoco.MjModel) -> None:
    config = MyoLegSettings(name="myoleg", model="myolegs26", reset_noise=0.1)
    env: MyoLeg = make_env(config, PhysicsConfig(), 8, "cpu", 0, differentiable=False)
    axes = world_axes(env.model)
    assert axes[0] == pytest.approx([0.0, -1.0, 0.0], abs=0.02), "these legs walk along -y"
    data, couplings = mujoco.MjData(env.model), Couplings(env.model)
    qpos, qvel, _ = env.state.physics
    assert len(couplings.joints) == 28
    for place, speed in zip(qpos.numpy(), qvel.numpy(), strict=True):
        # Fault: reset noise that breaks equality-coupled joints.
        np.testing.assert_allclose(couplings.satisfied(place.astype(float)), place, atol=1e-5)
        data.qpos[:], data.qvel[:] = place, speed
        mujoco.mj_forward(env.model, data)
        assert np.abs(data.efc_pos[: data.ne]).max() < 1e-5
        assert np.abs(data.efc_vel[: data.ne]).max() < 1e-4
    # Fault: a reward along an axis the model does not walk along, and "up" along the wrong one.
    state = env.state.physics
    moving = state._replace(qvel=torch.zeros_like(qvel).index_fill_(1, torch.tensor([1]), -1.25))
    root = env.root(moving)
    assert root.velocity[0, 0].item() == pytest.approx(1.25, rel=1e-3)
    assert root.up[:, 2].min() > 0.999
    for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        tipped = state.qpos.clone()
        quat = np.zeros(4)
        mujoco.mju_axisAngle2Quat(quat, np.array(axis), 0.8)
        mujoco.mju_mulQuat(quat, quat, np.array(tipped[0, 3:7].tolist()))
        tipped[:, 3:7] = torch.tensor(quat, dtype=torch.float32)
        assert env.root(state._replace(qpos=tipped)).up[0, 2].item() == pytest.approx(np.cos(0.8), abs=1e-3)
    assert env.sim.timestep == pytest.approx(config.control_timestep)
    assert env.action_size == 26
    transition = env.step(torch.zeros(8, 26))
    assert transition.obs.shape == (8, env.obs_size)
    assert transition.reward.isfinite().all()


@needs_myo_sim
def test_people_step_on_80_muscles_and_springs_right_the_pelvis() -> None:
    """The measured angles on an installed model: feet stand still at 1.25 m/s in mid-stance, and steps are long."""
    settings = {"clock": True, "symmetric": True, "reset": "cycle", "reset_noise": 0.0, "assist": {"epochs": 10}}
    config = MyoLegSettings.model_validate({"name": "myoleg", "source": "myo_sim", **settings})
    env = make_env(config, PhysicsConfig(), 2, "cpu", 0, differentiable=False)
    model, axes = env.model, world_axes(env.model)
    speed = torch.full((3,), 1.25)
    start = env.draw_phase(torch.tensor([0.0, 0.26, 0.5]), speed)
    data = mujoco.MjData(model)
    apart = []
    for k in range(3):
        data.qpos[:], data.qvel[:] = start.qpos[k].numpy(), start.qvel[k].numpy()
        mujoco.mj_forward(model, data)
        apart.append((data.body("calcn_r").xpos - data.body("calcn_l").xpos) @ axes[0])
        velocity = np.zeros(6)
        body = model.body("toes_r").id
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
        if k == 1:
            assert np.linalg.norm(velocity[3:]) < 0.2
    assert apart[0] == pytest.approx(0.64, abs=0.03)
    assert apart[2] == pytest.approx(-apart[0], abs=0.02)
    # Over the right foot the pelvis is 2 cm to the right (axes[1] is left) and moves as an inverted pendulum does, to
    # the right at strike, while each foot keeps its line.
    aside, drift = start.qpos[:, :3].numpy() @ axes[1], start.qvel[:, :3].numpy() @ axes[1]
    assert aside[1] == pytest.approx(-0.02, abs=0.01)
    assert drift[0] < -0.1
    assert drift[2] == pytest.approx(-drift[0], abs=0.02)
    lines = []
    for k in range(3):
        data.qpos[:] = start.qpos[k].numpy()
        mujoco.mj_kinematics(model, data)
        lines.append([data.body(f"calcn_{side}").xpos @ axes[1] for side in "rl"])
    assert np.ptp(lines, axis=0) == pytest.approx(0.0, abs=0.01)
    # Leaning forward by 0.1 rad, against 800 N m/rad; 1 cm aside, against 800 N/m
    lean = quat_exp(torch.tensor(0.1 * axes[1], dtype=torch.float32))
    state = StepState(*(part[:1].clone() for part in env.state.physics))
    state.qpos[0, 3:7] = quat_multiply(lean, torch.tensor(model.key("stand").qpos[3:7], dtype=torch.float32))
    state.qpos[0, :3] = torch.tensor(model.key("stand").qpos[:3] + 0.01 * axes[1], dtype=torch.float32)
    force = env.applied_force(state._replace(qvel=torch.zeros_like(state.qvel)))
    torque = quat_rotate(state.qpos[:, 3:7], force[:, 3:6])[0].numpy() @ axes.T
    assert torque == pytest.approx([0.0, -80.0, 0.0], abs=0.01)
    assert force[0, :3].numpy() @ axes.T == pytest.approx([0.0, -8.0, 0.0], abs=0.01)
    env.enter_epoch(10)
    assert not env.applied_force(state).any()
    assert MyoLeg.reference_settings(config).assist.epochs == 0
