"""Models whose step in mujoco_warp would be another one than in C MuJoCo are refused by name."""

import mujoco
import numpy as np
import pytest

from msk_ray.errors import UnsupportedModelError
from msk_ray.step.forward import WorldBatch


def _joint(attributes: str, options: str = "") -> str:
    return (
        f'<option gravity="0 0 0"/>{options}<worldbody><body><joint name="j" type="slide" axis="1 0 0" {attributes}/>'
        '<geom size=".1" mass="1"/></body></worldbody>'
    )


def _tendon(attributes: str) -> str:
    return f'{_joint("")}<tendon><fixed name="t" {attributes}><joint joint="j" coef="1"/></fixed></tendon>'


def _contact(floor: str, ball: str, more: str = "") -> str:
    return (
        f'<worldbody><geom name="floor" type="plane" size="1 1 1" {floor}/><body pos="0 0 .09"><freejoint/>'
        f'<geom name="ball" size=".1" {ball}/></body></worldbody>{more}'
    )


FALLS = 'solimp=".9 .5 .05"'
PAIR = '<contact><pair geom1="ball" geom2="floor" {}/></contact>'


def _velocities(xml: str, qpos: float | None) -> tuple[np.ndarray, np.ndarray]:
    """After a step in C MuJoCo, and in a batch."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{xml}</mujoco>")
    model.opt.tolerance = 1e-12
    data = mujoco.MjData(model)
    if qpos is not None:
        data.qpos[0] = qpos
    batch = WorldBatch(model, 1, 1, "cpu", tolerance=1e-9)
    batch.data.qpos.assign(data.qpos.astype(np.float32)[None])
    batch.data.qvel.zero_()
    batch.launch_step()
    mujoco.mj_step(model, data)
    return data.qvel, batch.data.qvel.numpy()[0]


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        (_joint('range="0 0.1" margin="0.2"'), r"limits of joint j have a margin of 0\.2, .*at most 0\.05"),
        (_joint('range="-.2 .2" margin=".25"'), r"limits of joint j .* write a margin of at most 0\.2"),
        (_tendon('range="0 0.1" margin="0.2"'), r"limits of tendon t have a margin of 0\.2, .*at most 0\.05"),
        (_joint('range="-.2 .2" solimplimit=".9 .5 .05"'), r"limits of joint j falls .*dmin 0\.9 above dmax 0\.5"),
        (_tendon('range="-.2 .2" solimplimit=".9 .5 .05"'), r"limits of tendon t falls .*solimplimit"),
        (
            f'{_joint("")}<equality><joint name="lock" joint1="j" {FALLS}/></equality>',
            r"impedance of equality lock falls .*write dmin <= dmax, or a power of 1",
        ),
        (_contact('priority="1" ' + FALLS, ""), r"contacts of geom floor with geom ball falls"),
        (_contact("", FALLS), r"contacts of geom floor with geom ball falls .*dmin 0\.9 above dmax 0\.725"),
        (_contact("", "", PAIR.format(FALLS)), r"contacts of geom floor with geom ball falls"),
    ],
)
def test_what_c_mujoco_steps_otherwise_is_refused(xml: str, message: str) -> None:
    with pytest.raises(UnsupportedModelError, match=message):
        WorldBatch(mujoco.MjModel.from_xml_string(f"<mujoco>{xml}</mujoco>"), 1, 1, "cpu")


@pytest.mark.parametrize(
    ("xml", "qpos"),
    [
        (_joint('range="-.2 .2" margin=".2"'), 0.05),
        (_joint('range="0 .1" margin=".2"', '<option><flag limit="disable"/></option>'), 0.02),
        (_tendon('range="-.2 .2" margin=".2"'), -0.05),
        (_joint('range="-.2 .2" solimplimit=".9 .5 .05 .5 1"'), 0.22),
        (_joint('range="-.2 .2" solimplimit=".5 .9 .05"'), 0.22),
        (_joint('frictionloss="1" solimpfriction=".9 .5 .05"'), None),
        (_contact(FALLS, 'priority="1"'), None),
        (_contact(FALLS, 'solmix="99" solimp=".5 .9 .05"'), None),
        (_contact(FALLS, "", PAIR.format('solimp=".5 .9 .05"')), None),
    ],
)
def test_what_is_accepted_steps_as_c_mujoco_does(xml: str, qpos: float | None) -> None:
    expected, found = _velocities(xml, qpos)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


TORUS = (
    '<plugin plugin="mujoco.sdf.torus"><instance name="ring"><config key="radius1" value=".35"/></instance></plugin>'
)


@pytest.mark.parametrize(
    "geoms",
    [
        '<geom type="sdf" mesh="ring"><plugin instance="ring"/></geom>',
        2 * '<geom type="sdf" mesh="ring"><plugin instance="ring"/></geom>',
        '<geom type="mesh" mesh="ring"/>',
    ],
    ids=["one", "two", "mesh"],
)
def test_plugins_are_refused_by_name(geoms: str) -> None:
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><extension>{TORUS}</extension><asset><mesh name="ring"><plugin instance="ring"/></mesh></asset>'
        f'<worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 1"><freejoint/>{geoms}</body></worldbody></mujoco>'
    )
    with pytest.raises(UnsupportedModelError, match=r'plugins \(instance ring\), .*write .*type="mesh" from files'):
        WorldBatch(model, 1, 1, "cpu")
