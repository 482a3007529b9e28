"""The float64 reference of what environments measure agrees with what they measure in training."""

import mujoco
import numpy as np
import torch

from msk_ray.diagnose.exact import ExactGround, ExactKinematics, ExactTendons
from msk_ray.step.autograd.ground import Ground
from msk_ray.step.autograd.kinematics import Kinematics
from msk_ray.step.autograd.tendon_lengths import Tendons
from msk_ray.step.forward import WorldBatch

MODEL = """<mujoco><worldbody><site name="anchor" pos="0 0 1"/>
  <body name="trunk" pos="0 0 .5"><freejoint/><geom name="trunk" size=".1 .2" type="capsule" pos=".1 0 0" mass="2"/>
    <body name="arm" pos="0 0 .1" quat="1 .2 0 0"><joint type="ball"/><site name="hand" pos="0 .1 .3" euler="10 20 0"/>
      <geom name="arm" type="box" size=".1 .05 .2" pos="0 0 .2" mass="1"/></body></body></worldbody>
  <tendon><spatial name="string"><site site="anchor"/><site site="hand"/></spatial></tendon></mujoco>"""


def test_frames_and_tendons_in_float64_are_those_in_float32() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL)
    rng = np.random.default_rng(0)
    qpos = rng.normal(size=(2, model.nq))
    for row in qpos:
        mujoco.mj_normalizeQuat(model, row)
    qvel = rng.normal(size=(2, model.nv))
    exact = torch.from_numpy(qpos), torch.from_numpy(qvel)
    batch = WorldBatch(model, 2, 1, "cpu")
    ours = Kinematics(batch)(*(part.float() for part in exact))
    reference = ExactKinematics(model)(*exact)
    bodies = ["trunk", "arm"]
    for name, names in (
        *((name, (bodies,)) for name in ("position", "orientation", "velocity", "angular_velocity")),
        *((name, ("hand",)) for name in ("site_position", "site_orientation", "site_velocity")),
        *((name, ("arm",)) for name in ("geom_position", "geom_velocity")),
        *((name, ("trunk",)) for name in ("center_of_mass", "com_velocity", "angular_momentum")),
        ("axis", ("arm", 2)),
    ):
        expected = getattr(reference, name)(*names)
        assert expected.dtype == torch.float64, name
        np.testing.assert_allclose(getattr(ours, name)(*names), expected, atol=2e-5, err_msg=name)
    length, rate = ExactTendons(model)(*exact)
    assert length.dtype == rate.dtype == torch.float64
    for found, expected in zip(Tendons(batch)(*(part.float() for part in exact)), (length, rate), strict=True):
        np.testing.assert_allclose(found, expected, atol=2e-5)


def test_distances_to_the_ground_in_float64_are_those_in_float32() -> None:
    """Above a step and a floor; past the reach; and with a ball in between, which is no ground."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="0 0 1"/><geom type="box" size=".5 .5 .2" rgba="0 0 0 0"/>
        <body pos="2 0 .3"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    points = torch.tensor([[[0.1, 0.2, 1.0], [2.0, 0.0, 1.0], [0.0, 0.0, 2.5]]])
    exact = ExactGround(model).below(points.double(), 2.0)
    assert exact.tolist() == [[0.8, 1.0, 2.0]]
    np.testing.assert_allclose(Ground(WorldBatch(model, 1, 1, "cpu")).below(points, 2.0), exact, atol=1e-6)
