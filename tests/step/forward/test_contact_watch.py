"""Contacts between groups of geoms in every substep, against C MuJoCo."""

import mujoco
import numpy as np

from msk_ray.step.forward import WorldBatch
from msk_ray.step.forward.contact_watch import ContactQuery, geoms_of

# A box with a ball on top, and another ball beside them.
MODEL = """<mujoco><option timestep=".002"/><worldbody><geom name="floor" type="plane" size="5 5 1"/>
<body name="box" pos="0 0 .099"><freejoint/><geom name="box" type="box" size=".1 .1 .1" mass="1"/>
  <body name="rider" pos="0 0 .19"><joint type="slide" axis="0 0 1"/><geom name="rider" size=".1" mass=".5"/>
    <site name="seat"/></body></body>
<body name="ball" pos="1 0 .099"><freejoint/><geom name="ball" size=".1" mass="2"/></body></worldbody>
</mujoco>"""
SUBSTEPS = 3


def exact(model: mujoco.MjModel, data: mujoco.MjData, primary: tuple[int, ...], secondary: tuple[int, ...]) -> list:
    """Force, number and largest force of contacts with constraint rows in the last step."""
    total, number, strongest, wrench = np.zeros(3), 0, 0.0, np.zeros(6)
    for i, contact in enumerate(data.contact):
        if contact.efc_address < 0:
            continue
        first, second = contact.geom
        mujoco.mj_contactForce(model, data, i, wrench)
        force = contact.frame.reshape(3, 3).T @ wrench[:3]
        if first in primary and second in secondary:
            total -= force
        elif second in primary and first in secondary:
            total += force
        else:
            continue
        number, strongest = number + 1, max(strongest, np.linalg.norm(force))
    return [*total, number, strongest]


def test_each_substep_has_the_contacts_of_c_mujoco() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    data = mujoco.MjData(model)
    data.qvel[0], data.qvel[2], data.qvel[-6] = 0.5, -0.2, 1.0
    data.qacc_warmstart[:] = 0.0
    everything = tuple(range(model.ngeom))
    whole = geoms_of(model, "subtree", model.body("box").id)
    query = ContactQuery(tuple((model.geom(name).id,) for name in ("box", "ball", "floor")), everything)
    within = ContactQuery((whole,), whole)
    batch = WorldBatch(model, 2, SUBSTEPS, "cpu", tolerance=1e-9)
    batch.contacts.add(query)
    batch.contacts.add(within)
    flying = data.qpos.copy()
    flying[[2, 10]] += 5.0
    batch.data.qpos.assign(np.stack((data.qpos, flying)).astype(np.float32))
    batch.data.qvel.assign(np.stack((data.qvel, 0.0 * data.qvel)).astype(np.float32))
    batch.launch_step()
    found = batch.contacts.figures[query].numpy()
    self_contacts = batch.contacts.figures[within].numpy()
    for k in range(SUBSTEPS):
        mujoco.mj_step(model, data)
        expected = np.array([exact(model, data, primary, query.secondary) for primary in query.primary])
        assert expected[0, 3] > 1
        assert expected[1, 3] == 1
        np.testing.assert_allclose(found[k, 0], expected, atol=5e-3 * np.abs(expected).max())
        np.testing.assert_array_equal(found[k, 0, :, 3], expected[:, 3])
        expected = np.array(exact(model, data, whole, whole))
        assert expected[3] == 1
        np.testing.assert_allclose(self_contacts[k, 0, 0], expected, atol=5e-3 * np.abs(expected).max())
    assert not found[:, 1, 1:].any(), "nothing touches the floor"
    grown = batch.resized(1)
    assert grown.contacts.queries == (query, within)


def test_geoms_of_every_kind() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL)
    ids = {name: model.geom(name).id for name in ("floor", "box", "rider", "ball")}
    assert geoms_of(model, "geom", ids["ball"]) == (ids["ball"],)
    assert geoms_of(model, "body", model.body("box").id) == (ids["box"],)
    assert geoms_of(model, "subtree", model.body("box").id) == (ids["box"], ids["rider"])
    assert geoms_of(model, "subtree", 0) == tuple(range(model.ngeom))
    assert geoms_of(model, "site", model.site("seat").id) == (ids["rider"],)
