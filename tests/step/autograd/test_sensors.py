"""Sensors as functions of the state, against C MuJoCo and its central differences."""

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.step import Simulation
from msk_ray.step.autograd.kinematics import Kinematics
from msk_ray.step.autograd.sensors import Readings, Sensors
from msk_ray.step.autograd.tendon_lengths import Tendons
from msk_ray.step.errors import ConfigError, UnsupportedModelError
from msk_ray.step.forward import WorldBatch

WORLDS = 3
ATTACHED = """
<gyro name="gyro" site="tip"/> <velocimeter name="velocimeter" site="tip"/>
<magnetometer name="magnetometer" site="tip"/> <gyro name="cut" site="tip" cutoff=".3"/>
<framepos name="pos" objtype="geom" objname="g"/> <framequat name="quat" objtype="body" objname="arm"/>
<framexaxis name="x" objtype="xbody" objname="hand"/> <frameyaxis name="y" objtype="site" objname="tip"/>
<framezaxis name="z" objtype="body" objname="world" reftype="site" refname="tip"/>
<framelinvel name="linvel" objtype="body" objname="arm"/> <frameangvel name="angvel" objtype="xbody" objname="arm"/>
<framepos name="pos in" objtype="site" objname="end" reftype="body" refname="arm"/>
<framequat name="quat in" objtype="geom" objname="g" reftype="site" refname="end"/>
<framelinvel name="linvel in" objtype="site" objname="end" reftype="geom" refname="g"/>
<frameangvel name="angvel in" objtype="site" objname="end" reftype="xbody" refname="base"/>
<subtreecom name="com" body="arm"/> <subtreelinvel name="comvel" body="arm"/> <subtreeangmom name="spin" body="base"/>
<jointpos name="jointpos" joint="slide"/> <jointvel name="jointvel" joint="hinge"/>
<ballquat name="ballquat" joint="ball"/> <ballangvel name="ballangvel" joint="ball"/>
<tendonpos name="tendonpos" tendon="t"/> <tendonvel name="tendonvel" tendon="t"/>
<actuatorpos name="hingepos" actuator="hinge"/> <actuatorvel name="hingevel" actuator="hinge"/>
<actuatorpos name="ballpos" actuator="ball"/> <actuatorvel name="ballvel" actuator="ball"/>
<actuatorpos name="pullpos" actuator="pull"/> <actuatorvel name="pullvel" actuator="pull"/>
"""
MODEL = f"""<mujoco><option magnetic=".2 -.5 .3"/><worldbody>
<body name="base" pos="1 2 3"><freejoint/><geom type="box" size=".1 .2 .3" mass="2" pos=".1 0 0"/>
  <body name="arm" pos=".3 .1 0" quat=".8 .6 0 0"><joint name="ball" type="ball" pos=".02 .03 .04"/>
    <geom name="g" type="capsule" fromto="0 0 0 .3 .1 .2" size=".03" mass="1"/>
    <site name="tip" pos=".2 .1 .1" quat=".5 .5 .5 .5"/>
    <body name="hand" pos=".3 0 .1"><joint name="slide" axis="1 .3 0" type="slide" ref=".1"/>
      <joint name="hinge" axis="0 1 .2" pos="0 .05 .02" ref=".3"/>
      <geom type="box" size=".05 .02 .03" mass=".5" pos="0 .02 0" euler="10 20 30"/><site name="end" pos="0 .1 0"/>
    </body></body></body></worldbody>
<tendon><spatial name="t"><site site="tip"/><site site="end"/></spatial></tendon>
<actuator><motor name="hinge" joint="hinge" gear="3"/><motor name="ball" joint="ball" gear="1 2 -1"/>
<motor name="pull" tendon="t" gear="-2"/><motor name="push" site="tip"/></actuator>
<sensor>{ATTACHED}<clock name="clock"/><accelerometer name="felt" site="tip"/>
<actuatorpos name="pushpos" actuator="push"/></sensor></mujoco>"""
OTHERS = ("clock", "felt", "pushpos")


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture(scope="module")
def sensors(model: mujoco.MjModel) -> Sensors:
    batch = WorldBatch(model, WORLDS, 1, "cpu")
    return Sensors(Kinematics(batch), lambda: Tendons(batch))


def names(model: mujoco.MjModel) -> list[str]:
    return [name for i in range(model.nsensor) if (name := model.sensor(i).name) not in OTHERS]


def exact(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Readings of C MuJoCo."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    return np.concatenate([data.sensor(name).data for name in names(model)])


def states(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """At the reference, where rotations are none and the arm has symmetric inertia; two others."""
    rng = np.random.default_rng(2)
    qpos = np.tile(model.qpos0, (WORLDS, 1))
    for row in qpos[1:]:
        mujoco.mj_integratePos(model, row, 0.4 * rng.normal(size=model.nv), 1.0)
    return qpos, rng.normal(size=(WORLDS, model.nv))


def test_values_and_gradients(model: mujoco.MjModel, sensors: Sensors) -> None:
    qpos, qvel = states(model)
    q = torch.tensor(qpos, dtype=torch.float32, requires_grad=True)
    v = torch.tensor(qvel, dtype=torch.float32, requires_grad=True)
    readings = sensors(q, v)
    found = torch.cat([readings[name] for name in names(model)], -1)
    expected = np.stack([exact(model, a, b) for a, b in zip(qpos, qvel, strict=True)])
    np.testing.assert_allclose(found.detach().numpy(), expected, atol=1e-5)
    assert np.abs(readings["cut"].detach().numpy()).max() == np.float32(0.3)
    weights = np.random.default_rng(3).normal(size=expected.shape)
    grad_q, grad_v = torch.autograd.grad((found * torch.tensor(weights, dtype=torch.float32)).sum(), (q, v))
    eps = 1e-6
    for w in range(WORLDS):
        slopes_q, slopes_v, tangent = np.zeros(model.nv), np.zeros(model.nv), np.zeros(model.nv)
        for i, direction in enumerate(np.eye(model.nv)):
            ends = []
            for sign in (eps, -eps):
                moved = qpos[w].copy()
                mujoco.mj_integratePos(model, moved, direction, sign)
                ends.append((moved, exact(model, moved, qvel[w]) @ weights[w]))
            slopes_q[i] = (ends[0][1] - ends[1][1]) / (2 * eps)
            # The raw gradient along the curve that integration follows.
            tangent[i] = grad_q[w].double().numpy() @ (ends[0][0] - ends[1][0]) / (2 * eps)
            up, down = (exact(model, qpos[w], qvel[w] + s * direction) @ weights[w] for s in (eps, -eps))
            slopes_v[i] = (up - down) / (2 * eps)
        np.testing.assert_allclose(tangent, slopes_q, atol=1e-5 * np.abs(slopes_q).max())
        np.testing.assert_allclose(grad_v[w], slopes_v, atol=1e-5 * np.abs(slopes_v).max())


def test_only_what_is_asked_for_is_computed(model: mujoco.MjModel, sensors: Sensors) -> None:
    qpos, qvel = (torch.tensor(part, dtype=torch.float32) for part in states(model))
    asked = []
    frames = lambda: asked.append("frames") or sensors.kinematics(qpos, qvel)  # noqa: E731
    readings = Readings(sensors, qpos, qvel, frames, lambda: pytest.fail("tendons"), lambda: pytest.fail("a step"))
    assert torch.equal(readings["jointpos"][:, 0], qpos[:, model.joint("slide").qposadr[0]])
    assert not asked
    assert readings["gyro"] is readings["gyro"]
    readings["velocimeter"]
    assert asked == ["frames"]


def test_what_cannot_be_read_is_refused_by_name(model: mujoco.MjModel, sensors: Sensors) -> None:
    readings = sensors(*(torch.tensor(part, dtype=torch.float32) for part in states(model)))
    with pytest.raises(
        UnsupportedModelError, match=r"sensor 'clock' cannot be read: clock is not among accelerometer, "
    ):
        readings["clock"]
    with pytest.raises(UnsupportedModelError, match="sensor 'pushpos' cannot be read: actuator 'push' acts on none of"):
        readings["pushpos"]
    with pytest.raises(ConfigError, match="belong to a step"):
        readings["felt"]
    with pytest.raises(ConfigError, match="the model has no sensor 'gryo': it has gyro, "):
        readings["gryo"]


FELT = """<mujoco><option timestep=".004"/><worldbody><geom name="floor" type="plane" size="5 5 1"/>
<body name="box" pos="0 0 .099"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/>
  <site name="inside" type="sphere" size=".3"/>
  <body name="arm" pos="0 0 .1"><joint name="hinge" axis="0 1 0"/><site name="joint" pos=".02 0 .1"/>
    <geom type="capsule" fromto="0 0 .1 0 0 .4" size=".02" mass=".3"/></body></body></worldbody>
<actuator><motor name="turn" joint="hinge" gear="2"/></actuator>
<sensor><touch name="touch" site="inside"/><accelerometer name="imu" site="joint" cutoff="4"/>
<force name="force" site="joint"/><torque name="torque" site="joint"/><actuatorfrc name="effort" actuator="turn"/>
<framelinacc name="linacc" objtype="site" objname="joint"/><frameangacc name="angacc" objtype="xbody" objname="arm"/>
<jointactuatorfrc name="at joint" joint="hinge"/>
<contact name="contact" body1="box" geom2="floor" data="found force" reduce="netforce"/></sensor></mujoco>"""


@pytest.mark.parametrize("mode", [None, "tape_per_substep", "tape_all"])
def test_forces_and_accelerations_are_those_of_the_last_substep(mode: str | None) -> None:
    model = mujoco.MjModel.from_xml_string(FELT)
    sim = Simulation(model, 2, 3, mode, tolerance=1e-9)
    qpos, qvel, act = sim.initial_state()
    qvel[:, 0], qvel[:, 6] = 0.3, 1.0
    qpos[1, 2] += 1.0  # in the air
    ctrl = torch.full((2, 1), 0.5)
    sim.step(ctrl, qpos, qvel, act)
    with pytest.raises(ConfigError, match=r"took no readings of sensors: call measure_sensors\(\) before a step"):
        sim.sensordata()
    sim.measure_sensors()
    sim.step(ctrl, qpos, qvel, act)
    found = sim.sensordata()
    for w in range(2):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[w], qvel[w], ctrl[w]
        mujoco.mj_step(model, data, 3)
        np.testing.assert_allclose(found[w], data.sensordata, atol=2e-3 * np.abs(data.sensordata).max())
        assert (data.sensor("touch").data[0] > 5.0) == (w == 0)
        assert data.sensor("contact").data[0] == (4.0 if w == 0 else 0.0)


def test_steps_take_no_readings_unless_asked() -> None:
    model = mujoco.MjModel.from_xml_string(FELT)
    batch = WorldBatch(model, 1, 1, "cpu")
    batch.data.sensordata.fill_(7.0)
    batch.launch_step()
    assert not batch.data.sensordata.numpy().any(), "mujoco_warp clears them"
    batch.measures_sensors = True
    batch.launch_step()
    assert batch.data.sensordata.numpy().any()
    grown = batch.resized(2)
    assert grown.measures_sensors
