"""The table of features: checked before the first step, and printed in the docs."""

from pathlib import Path

import mujoco
import pytest
from scenes import ant, cartpole

from msk_ray.errors import UnsupportedModelError
from msk_ray.physics.adjoint.coverage import check_supported, table, unsupported

_DOC = Path(__file__).resolve().parents[2] / "docs" / "differentiation.md"


def test_the_docs_print_the_table_of_the_code():
    text = _DOC.read_text(encoding="utf-8")
    assert table() in text


def test_own_models_are_covered():
    assert unsupported(ant()) == {}
    assert unsupported(cartpole()) == {}


@pytest.mark.parametrize(
    ("xml", "named"),
    [
        ('<option integrator="RK4"/><worldbody><body><joint/><geom size=".1"/></body></worldbody>', "RK4"),
        ('<option density="1.2"/><worldbody><body><joint/><geom size=".1"/></body></worldbody>', "fluid"),
        (
            '<worldbody><body name="b"><joint/><geom size=".1"/></body></worldbody>'
            '<equality><weld name="pin" body1="b"/></equality>',
            "equality pin",
        ),
        (
            '<option integrator="implicitfast"/><worldbody><body name="ball"><freejoint/><geom size=".1"/></body>'
            "</worldbody>",
            "body ball",
        ),
        (
            '<worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody><tendon><fixed name="arm" '
            'armature="1"><joint joint="j" coef="1"/></fixed></tendon>',
            "tendon arm",
        ),
    ],
)
def test_what_is_not_covered_is_named(xml, named):
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{xml}</mujoco>")
    with pytest.raises(UnsupportedModelError, match=named):
        check_supported(model, "tape_per_substep")
