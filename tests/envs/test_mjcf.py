"""Environments from an MJCF file: model, start, controls, what can be measured, and what is refused."""

import sys
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.config import overlay, parse_config
from msk_ray.envs import Env, env_class, make_env
from msk_ray.errors import ConfigError, MskRayError, UnsupportedModelError
from msk_ray.step import Simulation
from msk_ray.step.autograd.modes import BACKWARD_MODES

MODEL = """<mujoco><option timestep="0.004" integrator="implicitfast" iterations="33"/>
  <worldbody><geom name="floor" type="plane" size="5 5 1"/>
    <body name="ball" pos="0 0 .5"><freejoint/><geom name="ball" size=".1" mass="2"/>
      <body name="arm" pos="0 0 .1"><joint name="hinge" axis="0 1 0" range="-10 10"/>
        <site name="tip" pos="0 0 .4"/>
        <geom type="capsule" fromto="0 0 .1 0 0 .4" size=".02" contype="0" conaffinity="0"/></body></body></worldbody>
  <actuator><position name="aim" joint="hinge" kp="5" ctrlrange="0.1 0.5"/></actuator>
  <sensor><gyro name="spin" site="tip"/><accelerometer name="jolt" site="tip"/></sensor>
  <keyframe><key name="high" qpos="0 0 2 1 0 0 0 0.1" qvel="1 0 0 0 0 0 0"/>
    <key name="low" qpos="0 0 .099 .6 .8 0 0 0"/></keyframe></mujoco>"""

BALL = """
import torch
from msk_ray import Memory, MjcfEnv, Reward
from msk_ray.step.autograd.contact_state import AirTime
from msk_ray.step.autograd.ground import grid

class BallReward(Reward):
    height: float = 2.0

class Ball(MjcfEnv):
    class Settings(MjcfEnv.Settings):
        reward: BallReward = BallReward()

    mjcf = "models/ball.xml"
    reward_names = ("height", "touch")
    without_gradient = ("touch",)

    def observe(self, state, action):
        return torch.cat((self.frames(state).position("ball"), state.qvel, action), -1)

    def reward_terms(self, state, action, obs):
        height = self.config.reward.height * self.frames(state).center_of_mass("ball")[:, 2]
        return torch.stack((height, self.contact_forces(state, "ball")[:, 2]), -1)

class Feeling(Ball):
    def observe(self, state, action):
        return self.contact_forces(state, "ball")

class Sensing(Ball):
    without_gradient = ()

    def observe(self, state, action):
        return torch.cat((self.sensors(state)["spin"], action), -1)

    def reward_terms(self, state, action, obs):
        contact = self.contact(state, "ball", "body", against="floor", by="geom")
        jolt = self.sensors(state)["jolt"].norm(dim=-1)
        return torch.stack((obs.sum(-1) + contact.force[:, 0, 2], jolt + 0.0 * obs.sum(-1)), -1)

    def fell(self, state):
        self.last = self.contact(state, ["ball", "arm"], "body")
        return self.last.touching[-1, :, 1]

class Looking(Ball):
    without_gradient = ()

    def prepare(self):
        self.grid = grid(0.2, 0.2, 0.2).to(self.device)

    def observe(self, state, action):
        return self.ground.scan(self.frames(state), "ball", self.grid, 3.0)

    def reward_terms(self, state, action, obs):
        feet = self.frames(state).site_position(["tip"])
        return torch.stack((obs.sum(-1), self.ground.below(feet, 1.0)[:, 0]), -1)

class Timing(Ball):
    def memories(self):
        return {"air": Memory(4)}

    def remember(self, state, action):
        contact, air = self.contact(state, "ball"), AirTime.of(self.memory["air"])
        return {"air": air.after(contact.touching, self.model.opt.timestep).memory}

    def observe(self, state, action):
        return torch.cat((self.memory["air"], state.qvel), -1)

class Groping(Ball):
    def observe(self, state, action):
        return self.contact(state, "ball").force.flatten(1)

class Jolted(Ball):
    def observe(self, state, action):
        return self.sensors(state)["jolt"]

class Cut(Ball):
    def reward_terms(self, state, action, obs):
        return super().reward_terms(state, action, obs).detach()

class Flat(Ball):
    def observe(self, state, action):
        return state.qpos[:, 0]

class Strung(Ball):
    def observe(self, state, action):
        return self.tendons(state)[0]

class Homeless(MjcfEnv):
    reward_names = ()
    observe = Ball.observe
    reward_terms = Ball.reward_terms

class Unfinished(MjcfEnv):
    mjcf = "models/ball.xml"
    reward_names = ()

class Aimless(MjcfEnv):
    mjcf = "models/ball.xml"
    observe = Ball.observe

class Free(Ball):
    mjcf = "models/free.xml"

class Led(Ball):
    mjcf = "models/led.xml"

class Edited(Ball):
    @classmethod
    def edit(cls, spec, config, physics):
        spec.geom("ball").mass = 7.0
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a module `ball` and its models; what runs here is started elsewhere."""
    home = tmp_path / "home"
    (home / "models").mkdir(parents=True)
    (home / "ball.py").write_text(BALL)
    (home / "models" / "ball.xml").write_text(MODEL)
    (home / "models" / "free.xml").write_text(MODEL.replace(' ctrlrange="0.1 0.5"', ""))
    led = MODEL.replace("<worldbody>", '<worldbody><body name="hook" mocap="true"/>')
    (home / "models" / "led.xml").write_text(led.replace('name="high"', 'name="high" mpos="0 0 3"'))
    (home / "models" / "torn.xml").write_text(MODEL[:100])
    monkeypatch.syspath_prepend(home)
    monkeypatch.chdir(tmp_path)
    yield home
    sys.modules.pop("ball", None)


def _make(name: str = "Ball", nworld: int = 4, differentiable: bool = False, **values: Any) -> Env[Any]:
    settings = {"env": {"name": f"ball:{name}", "nworld": nworld}}
    config = parse_config(overlay(settings, {key.replace("__", "."): value for key, value in values.items()}))
    return make_env(config.env, config.physics, nworld, "cpu", 0, differentiable=differentiable)


def _model(name: str = "Ball", **values: Any) -> mujoco.MjModel:
    settings = {"env": {"name": f"ball:{name}"}}
    config = parse_config(overlay(settings, {key.replace("__", "."): value for key, value in values.items()}))
    return env_class(config.env).build_model(config.env, config.physics)


@pytest.mark.filterwarnings("ignore:the model may stop the constraint solver")
def test_iterations_of_the_file_are_raised_and_those_of_the_physics_section_kept(home: Path) -> None:
    assert _make().sim.batch.limits == (100, 50)
    assert _make(physics__iterations=33).sim.batch.limits == (33, 50)
    assert _make(physics__iterations=200, physics__ls_iterations=9).sim.batch.limits == (200, 9)


def test_options_are_the_files_unless_the_physics_section_says_otherwise(home: Path) -> None:
    model = _model()
    assert (model.opt.timestep, model.opt.iterations) == (pytest.approx(0.004), 33)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    changed = _model(physics__substeps=2, physics__integrator="Euler", physics__cone="elliptic")
    assert changed.opt.timestep == pytest.approx(0.01)
    assert changed.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert changed.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert _model("Edited").body("ball").mass[0] == 7.0


def test_episodes_start_about_a_keyframe(home: Path) -> None:
    still = _make(env__stochastic_reset=False)
    np.testing.assert_allclose(still.state.physics.qpos[0], [0, 0, 2, 1, 0, 0, 0, 0.1], atol=1e-6)
    np.testing.assert_allclose(still.state.physics.qvel[0], [1, 0, 0, 0, 0, 0, 0], atol=1e-6)
    noisy = _make(nworld=256, env__keyframe="low", env__reset_noise=0.5, env__reset_velocity_noise=0.25)
    qpos, qvel, _ = noisy.state.physics
    np.testing.assert_allclose(qpos[:, 3:7].norm(dim=-1), 1.0, atol=1e-6)
    tangent = noisy.sim.tangent.difference(torch.tensor([0, 0, 0.099, 0.6, 0.8, 0, 0, 0]).expand(256, 8), qpos)
    assert tangent[:, :6].abs().max() <= 0.5 + 1e-5
    assert tangent[:, :6].abs().amax(0).min() > 0.45, "some degree of freedom is not moved"
    assert qpos[:, 7].abs().max() == pytest.approx(np.deg2rad(10.0)), "a start outside of the joint's range"
    assert 0.2 < qvel.abs().max() <= 0.25


def test_actions_span_the_control_ranges(home: Path) -> None:
    env = _make(nworld=3)
    controls = env.control(torch.tensor([[-1.0], [0.0], [1.0]]))
    np.testing.assert_allclose(controls[:, 0], [0.1, 0.3, 0.5], atol=1e-6)


def test_a_reward_of_frames_has_a_gradient_and_one_of_forces_a_value(home: Path) -> None:
    env = _make(nworld=2, differentiable=True, env__keyframe="low", env__stochastic_reset=False)
    for _ in range(10):
        transition = env.step(torch.zeros(2, 1), auto_reset=False)
    assert (transition.terms[:, 1] > 5.0).all()
    assert not env.contact_forces(env.state.physics, "ball").requires_grad
    env.state = env.state.detach()
    qpos = env.state.physics.qpos.clone().requires_grad_()
    env.state = env.state._replace(physics=env.state.physics._replace(qpos=qpos))
    env.step(torch.zeros(2, 1)).reward.sum().backward()
    assert qpos.grad is not None
    assert qpos.grad.abs().sum() > 0.1


def test_sensors_and_contacts_of_a_step(home: Path) -> None:
    env = _make("Sensing", nworld=2, differentiable=True, env__keyframe="low", env__stochastic_reset=False)
    data = mujoco.MjData(env.model)
    state = env.state.physics
    data.qpos[:], data.qvel[:] = state.qpos[0], state.qvel[0]
    for _ in range(4):
        transition = env.step(torch.zeros(2, 1), auto_reset=False)
        data.qacc_warmstart[:] = 0.0
        data.ctrl[:] = 0.3
        mujoco.mj_step(env.model, data, env.sim.substeps)
    reached = data.sensordata.copy()
    mujoco.mj_forward(env.model, data)
    np.testing.assert_allclose(transition.obs[0, :3].detach(), data.sensor("spin").data, atol=1e-4)
    assert transition.terms[0, 1] == pytest.approx(np.linalg.norm(reached[3:]), rel=1e-2)
    assert env.last.touching[:, :, 0].all()
    assert not env.last.touching[:, :, 1].any()
    assert transition.terms[0, 0] == pytest.approx(float(transition.obs[0].sum() + env.last.force[0, 0, 2]), rel=1e-4)
    assert env.last.force[0, 0, 2] > 1.0
    env.state = env.state.detach()
    qvel = env.state.physics.qvel.clone().requires_grad_()
    env.state = env.state._replace(physics=env.state.physics._replace(qvel=qvel))
    env.step(torch.zeros(2, 1)).reward.sum().backward()
    assert qvel.grad is not None
    assert qvel.grad.abs().sum() > 0.1


def test_a_scan_of_the_ground_is_observed(home: Path) -> None:
    env = _make("Looking", nworld=2, differentiable=True, env__keyframe="high", env__stochastic_reset=False)
    with torch.no_grad():
        assert env.observation().tolist() == [[pytest.approx(2.0)] * 4] * 2
    qpos = env.state.physics.qpos.clone().requires_grad_()
    env.state = env.state._replace(physics=env.state.physics._replace(qpos=qpos))
    transition = env.step(torch.zeros(2, 1))
    assert transition.terms[:, 1].tolist() == [1.0, 1.0], "the tip is out of reach"
    transition.obs.sum().backward()
    assert qpos.grad is not None
    assert qpos.grad[:, 2].tolist() == pytest.approx([4.0, 4.0], rel=1e-4)


@pytest.mark.parametrize(("keyframe", "times"), [("high", [0.04, 0.0, 0.0, 0.0]), ("low", [0.0, 0.04, 0.0, 0.0])])
def test_time_in_the_air_is_remembered(home: Path, keyframe: str, times: list[float]) -> None:
    env = _make("Timing", nworld=2, env__keyframe=keyframe, env__stochastic_reset=False)
    with torch.no_grad():
        for _ in range(2):
            obs = env.step(torch.zeros(2, 1)).obs
    assert obs[:, :4].tolist() == [pytest.approx(times, abs=1e-6)] * 2


def test_what_is_measured_of_a_state_is_computed_once_and_with_gradients_where_asked(home: Path) -> None:
    env = _make(nworld=2)
    state = env.state.physics._replace(qpos=env.state.physics.qpos.clone().requires_grad_())
    with torch.no_grad():
        assert not env.frames(state).position("ball").requires_grad
    assert env.frames(state).position("ball").requires_grad
    assert env.frames(state) is env.frames(state)
    assert env.frames(state) is not env.frames(state._replace())


def test_a_world_that_diverged_has_no_forces(home: Path) -> None:
    env = _make(nworld=2, env__keyframe="low")
    physics = env.state.physics
    env.state = env.state._replace(
        physics=physics._replace(qvel=physics.qvel.clone().index_fill_(0, torch.tensor(1), 1e9))
    )
    transition = env.step(torch.zeros(2, 1))
    assert transition.diverged.tolist() == [False, True]
    assert torch.isfinite(transition.terms).all()
    assert transition.terms[1, 1] == 0.0


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("Ball", {"env__model": "gone.xml"}, "env.model: no file .*/home/gone.xml; write a path relative to"),
        ("Ball", {"env__model": "models/torn.xml"}, "models/torn.xml: "),
        ("Ball", {"env__keyframe": "middle"}, "env.keyframe: the model has no keyframe 'middle'; it has high, low"),
        ("Ball", {"env__control_timestep": 0.03}, "write physics.substeps: 8, or env.control_timestep: 0.032"),
        ("Ball", {"physics__solref": [0.1, 1.0]}, "physics.solref: env ball:Ball does not read it; leave it out"),
        ("Ball", {"env__stochastic_reset": False, "env__reset_noise": 0.1}, "env.reset_noise: nothing reads it while"),
        ("Ball", {"env__reward__heigt": 1.0}, "env.reward.heigt: unknown key; did you mean 'height'"),
        ("Free", {}, "actuator aim has no ctrlrange, so no control for actions of -1 and 1: write a ctrlrange"),
        ("Led", {}, "the keyframe moves mocap body hook, which stays where the model puts it: write mpos and mquat of"),
        ("Feeling", {}, "use them in remember, reward_terms, fell or outcome_terms, not in observe"),
        ("Groping", {}, "contacts belong to a step, not to a state: use them in remember, reward_terms"),
        ("Jolted", {}, "sensors of forces and accelerations belong to a step, not to a state: use them in"),
        ("Flat", {}, r"observe of Flat has shape \(4,\), not \(worlds, entries\) with 4 worlds"),
        ("Strung", {}, "the model has no tendons"),
        ("Homeless", {}, "Homeless has no model: write `mjcf = 'model.xml'` in the class"),
        (
            "Aimless",
            {},
            r"Aimless has no reward: write terms = \(Term\(name, weight, function\), \.\.\.\) in the class",
        ),
        ("Unfinished", {}, "ball:Unfinished lacks observe:"),
    ],
)
def test_what_does_not_fit_is_refused_before_the_first_step(
    home: Path, name: str, values: dict[str, Any], message: str
) -> None:
    with pytest.raises(MskRayError, match=message) as caught:
        _make(name, **values)
    assert isinstance(caught.value, ConfigError | UnsupportedModelError)
    assert "\n" not in str(caught.value)


def test_a_reward_without_a_gradient_is_warned_of_where_one_is_wanted(home: Path) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="reward_terms")
        _make("Cut", nworld=2)
    with pytest.warns(UserWarning, match="reward_terms of Cut has no gradient to the state or the action"):
        _make("Cut", nworld=2, differentiable=True)


def test_forces_are_those_of_the_last_substep_in_every_backward_mode() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL)
    found = {}
    for mode in (None, *BACKWARD_MODES):
        sim = Simulation(model, 2, 5, mode)
        qpos, qvel, act = sim.initial_state()
        qpos[:, 2] = 0.11
        for _ in range(8):
            ctrl = torch.zeros(2, 1, requires_grad=mode is not None)
            qpos, qvel, act = sim.step(ctrl, qpos.detach(), qvel.detach(), act)
        found[mode] = sim.contact_forces()
    data = mujoco.MjData(model)
    data.qpos[2] = 0.11
    wrench = np.zeros(6)
    for step in range(40):
        # As in an env step, whose first substep starts the solver from nothing.
        if step % 5 == 0:
            data.qacc_warmstart[:] = 0.0
        mujoco.mj_step(model, data)
    assert data.ncon == 1
    mujoco.mj_contactForce(model, data, 0, wrench)
    assert wrench[0] > 1.0
    for mode, force in found.items():
        np.testing.assert_allclose(force[:, model.geom("ball").id, 2], wrench[0], rtol=5e-3, err_msg=str(mode))
        np.testing.assert_allclose(force[:, model.geom("floor").id, 2], -wrench[0], rtol=5e-3, err_msg=str(mode))
