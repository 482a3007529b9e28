"""The table of features: checked before the first step, and printed in the docs."""

from pathlib import Path

import mujoco
import pytest
from scenes import ant, cartpole

from msk_ray.errors import UnsupportedModelError
from msk_ray.physics import WorldBatch
from msk_ray.physics.adjoint.coverage import check_supported, table, unsupported

_DOC = Path(__file__).resolve().parents[2] / "docs" / "step" / "coverage.md"


def test_the_docs_print_the_table_of_the_code():
    text = _DOC.read_text(encoding="utf-8")
    assert table() in text


def test_own_models_are_covered():
    assert unsupported(ant()) == {}
    assert unsupported(cartpole()) == {}


def test_a_model_without_geoms_can_be_looked_at() -> None:
    body = '<body><joint/><inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    assert unsupported(model) == {}


@pytest.mark.parametrize(
    ("xml", "named"),
    [
        (
            '<option integrator="implicit"/><worldbody><body><joint/><geom size=".1"/></body></worldbody>',
            r'\(integrator IMPLICIT\)\. Write integrator="Euler" or "implicitfast"; --integrator of gradcheck',
        ),
        (
            '<option integrator="RK4"/><worldbody><body name="a"><joint/><geom size=".1"/></body></worldbody><equality>'
            '<weld name="w" body1="a"/></equality>',
            r'RK4 with connect and weld equalities \(equality w\)\. Write integrator="Euler" or "implicitfast"\.',
        ),
        (
            '<option integrator="implicitfast"/><worldbody><body><joint/><geom size=".1"/><site name="s" pos="1 0 0"/>'
            '</body><body><joint/><geom size=".1"/><site name="t"/></body></worldbody>'
            '<actuator><motor name="pull" site="s" refsite="t" gear="1 0 0 0 0 0"/></actuator>',
            r'sites of different branches \(actuator pull\)\. Write integrator="Euler"',
        ),
        (
            '<option noslip_iterations="3"/><worldbody><body><joint/><geom size=".1"/></body></worldbody>',
            r'noslip iterations .*\. Write noslip_iterations="0"; a larger impratio',
        ),
        (
            '<option density="1.2"/><worldbody><body><joint/><geom name="wing" size=".1" fluidshape="ellipsoid"/>'
            "</body></worldbody>",
            r'ellipsoid model \(geom wing\)\. Write fluidshape="none"',
        ),
        (
            '<worldbody><body><joint/><geom size=".1"/><site name="s" pos="1 0 0"/></body><site name="t"/></worldbody>'
            '<tendon><spatial name="arm" armature="1"><site site="s"/><site site="t"/></spatial></tendon>',
            r'spatial tendons \(tendon arm\)\. Write armature="0"',
        ),
        (
            '<worldbody><body gravcomp="1"><joint name="j" actuatorgravcomp="true" actuatorfrcrange="-1 1"/>'
            '<geom size=".1"/></body></worldbody><actuator><motor joint="j"/></actuator>',
            r'joint or without actuation \(joint j\)\. Write actuatorgravcomp="false"',
        ),
    ],
)
def test_what_is_not_covered_is_named(xml, named):
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{xml}</mujoco>")
    with pytest.raises(UnsupportedModelError, match=named):
        check_supported(model, "tape_per_substep")


def test_actuators_that_only_c_mujoco_turns_off_are_refused() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option actuatorgroupdisable="2"/><worldbody><body><joint name="j"/><geom size=".1"/></body>'
        "</worldbody>"
        '<actuator><motor joint="j"/><motor name="off" joint="j" group="2"/></actuator></mujoco>'
    )
    with pytest.raises(UnsupportedModelError, match="actuator off is in a group that option actuatorgroupdisable"):
        WorldBatch(model, 1, 1, "cpu")
    model.opt.disableactuator = 0
    WorldBatch(model, 1, 1, "cpu")


def _body(kind: str, size: str, height: float) -> str:
    return f'<body pos="0 0 {height}"><freejoint/><geom name="{kind}" type="{kind}" size="{size}"/></body>'


def test_convex_pairs_are_exact(recwarn: pytest.WarningsRecorder) -> None:
    bodies = _body("cylinder", ".1 .1", 0.1) + _body("ellipsoid", ".1 .1 .05", 0.3)
    check_supported(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"), "tape_all")
    assert not recwarn.list
