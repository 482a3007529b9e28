"""Time in the air, by hand; names of what touches."""

import mujoco
import pytest
import torch

from msk_ray.step.autograd.contact_state import AirTime, Contact, ContactQueries
from msk_ray.step.autograd.kinematics import Kinematics
from msk_ray.step.errors import ConfigError
from msk_ray.step.forward import WorldBatch

MODEL = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/><body name="leg"><freejoint/>
<geom name="thigh" size=".1"/><body name="foot" pos="0 0 -.3"><geom name="heel" size=".1"/><geom name="toe" size=".1"/>
<site name="sole"/></body></body></worldbody></mujoco>"""


def test_time_in_the_air_by_hand() -> None:
    """Two feet, one world, substeps of 0.1 s: the first lands in the second substep, the other one stays down."""
    memory = torch.zeros(1, 8)
    first = AirTime.of(memory).after(torch.tensor([[[False, True]], [[False, True]]]), 0.1)
    assert first.air.tolist() == [pytest.approx([0.2, 0.0])]
    assert first.contact.tolist() == [pytest.approx([0.0, 0.2])]
    second = AirTime.of(first.memory).after(torch.tensor([[[False, True]], [[True, True]]]), 0.1)
    assert second.air.tolist() == [[0.0, 0.0]]
    assert second.last_air.tolist() == [pytest.approx([0.4, 0.0])]
    assert second.contact.tolist() == [pytest.approx([0.1, 0.4])]
    assert second.first_contact(0.2).tolist() == [[True, False]]
    third = second.after(torch.tensor([[[True, False]]]), 0.1)
    assert third.last_contact.tolist() == [pytest.approx([0.0, 0.5])]
    assert third.memory.shape == memory.shape


def test_a_contact_has_the_last_substep_in_front() -> None:
    figures = torch.tensor([[[[0.0, 0.0, 3.0, 1.0, 3.0]]], [[[0.0, 1.0, 5.0, 2.0, 4.0]]]])
    contact = Contact.of(figures)
    assert contact.force.tolist() == [[[0.0, 1.0, 5.0]]]
    assert contact.number.tolist() == [[2.0]]
    assert contact.strongest.flatten().tolist() == [3.0, 4.0]
    assert contact.touching.all()
    none = contact.without(torch.tensor([True]))
    assert not none.touching.any()
    assert not none.force.any()


def test_parts_are_named() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL)
    queries = ContactQueries(Kinematics(WorldBatch(model, 1, 1, "cpu")))
    heel, toe, thigh = (model.geom(name).id for name in ("heel", "toe", "thigh"))
    assert queries("heel") == (((heel,),), tuple(range(4)))
    assert queries(["foot", "leg"], "subtree", "floor", "geom") == (((heel, toe), (thigh, heel, toe)), (0,))
    assert queries("sole", "site").primary == ((heel, toe),)
    assert queries(["heel"]) is queries("heel")
    with pytest.raises(ConfigError, match="no body 'knee': it has world, leg, foot"):
        queries("knee", "body")
    with pytest.raises(ConfigError, match="contacts of a 'joint': write 'geom', 'body', 'site' or 'subtree'"):
        queries("knee", "joint")
