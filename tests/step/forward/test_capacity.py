"""Room for contacts and rows: bounded, tried out, and what happens where it does not suffice."""

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from mujoco_warp import OverflowType
from scenes import ant, cartpole, studded_plate

from msk_ray.errors import SimulationError
from msk_ray.step.adjoint.taped_step import TapedStep, WarpState
from msk_ray.step.forward import WorldBatch, capacity
from msk_ray.step.forward.capacity import Capacity, convex_room, default_capacity, geometric_bound, probe
from msk_ray.step.forward.overflow import ITERATION_BITS, LOST_BITS, loss_error, needed


def test_a_small_bound_is_taken_as_it_is_and_worked_out_by_hand():
    # 8 capsules of 2 contacts and a sphere of 1 on the plane, 4 pyramid rows each; 8 hinges limited on both sides.
    assert geometric_bound(ant()) == Capacity(17, 4 * 17 + 2 * 8)
    assert default_capacity(ant()) == (Capacity(17, 84), Capacity(17, 84))


def test_a_model_that_can_have_no_constraints_gets_no_room_for_them():
    model = cartpole()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert default_capacity(model) == (Capacity(0, 0), Capacity(0, 0))
    model.jnt_limited[:] = [1, 0]  # on both sides
    assert geometric_bound(model) == Capacity(0, 2)
    model = ant()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    assert geometric_bound(model) == Capacity(0, 0)


@pytest.mark.parametrize("integrator", ["EULER", "IMPLICITFAST"])
def test_without_room_for_rows_the_step_is_that_of_c_mujoco(integrator):
    """Damped, because implicit damping needs M qacc, which mujoco_warp leaves to its solver."""
    model = cartpole()
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.dof_damping[:] = [3.0, 0.1]
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = [0.3, 0.7], [1.0, -2.0], 0.5
    batch = WorldBatch(model, 1, 2, "cpu")
    for name in ("qpos", "qvel", "ctrl"):
        getattr(batch.data, name).assign(getattr(data, name)[None].astype(np.float32))
    batch.launch_step()
    mujoco.mj_step(model, data, nstep=2)
    np.testing.assert_allclose(batch.data.qvel.numpy()[0], data.qvel, rtol=1e-5)
    np.testing.assert_allclose(batch.data.qpos.numpy()[0], data.qpos, rtol=1e-5)


def test_a_large_bound_is_tried_out():
    model = studded_plate()
    start, bound = default_capacity(model)
    assert bound == Capacity(320, 4 * 320)
    # It lands on 64 of its 320 studs.
    assert 64 <= start.contacts < 160
    assert 256 <= start.rows < 640


def test_the_probe_is_repeatable(monkeypatch):
    monkeypatch.setattr(capacity, "_PROBED", {})
    first = probe(studded_plate())
    monkeypatch.setattr(capacity, "_PROBED", {})
    assert probe(studded_plate()) == first


def test_of_a_geom_on_a_height_field_mujoco_warp_keeps_four_contacts():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><hfield name="h" nrow="3" ncol="3" size="1 1 .1 .1"/></asset><worldbody>
        <geom type="hfield" hfield="h"/><body pos="0 0 .2"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    assert default_capacity(model) == (Capacity(4, 4 * 4),) * 2
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 300)
    assert data.ncon == 6, "C MuJoCo keeps more"
    batch = WorldBatch(model, 1, 1, "cpu")
    batch.data.qpos.assign(data.qpos[None].astype(np.float32))
    batch.launch_step()
    assert batch.data.nacon.numpy()[0] == 4


def test_on_height_fields_the_convex_collider_has_room_for_the_geoms_over_one_field() -> None:
    """Four fields, and a body of 20 capsules and a sphere: at 1.5 times 20, rounded up to 32."""
    capsules = "".join(f'<geom type="capsule" size=".1 .2" pos="{i} 0 0"/>' for i in range(20))
    fields = "".join(f'<geom type="hfield" hfield="h" pos="{2 * i} 0 0"/>' for i in range(4))
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><hfield name="h" nrow="3" ncol="3" size="1 1 .1 .1"/></asset><worldbody>
        {fields}<body pos="0 0 1"><freejoint/>{capsules}<geom size=".1"/></body></worldbody></mujoco>"""
    )
    assert convex_room(model, 100) == 32
    assert convex_room(model, 200) == 50, "a quarter of the contacts"
    assert convex_room(model, 20) == 20, "no more than contacts"
    assert WorldBatch(model, 2, 1, "cpu", capacity=Capacity(100, 64)).data.naccdmax == 2 * 32
    assert convex_room(ant(), 17) == 17


def test_convex_pairs_of_a_single_contact_keep_their_room_on_a_height_field() -> None:
    """Ten ellipsoids in each other's way: 45 pairs, each one contact and one pair of the convex collider."""
    bodies = "".join(
        f'<body pos="0 0 {i}"><freejoint/><geom type="ellipsoid" size=".1 .2 .3"/></body>' for i in range(10)
    )
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><hfield name="h" nrow="3" ncol="3" size="1 1 .1 .1"/></asset><worldbody>
        <geom type="hfield" hfield="h"/>{bodies}</worldbody></mujoco>"""
    )
    contacts = default_capacity(model)[0].contacts
    assert contacts == 45 + 10 * 4
    assert convex_room(model, contacts) == contacts


def test_without_a_bound_the_probe_decides():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><flexcomp name="cloth" type="grid" count="3 3 1"
        spacing=".1 .1 .1" pos="0 0 .05" dim="2" radius=".01" mass="1"/></worldbody></mujoco>"""
    )
    start, bound = default_capacity(model)
    assert bound is None
    assert start.contacts >= 48


def test_every_overflow_of_mujoco_warp_is_known():
    """A new bit has to be sorted before it can pass unseen."""
    unread = int(OverflowType.TACTILE)
    assert LOST_BITS | ITERATION_BITS | unread == int(OverflowType.ALL)
    assert not LOST_BITS & (ITERATION_BITS | unread)


def test_what_to_write_is_enough_room_for_what_was_asked():
    now = Capacity(10, 20)
    assert needed(int(OverflowType.NEFC), now, Capacity(5, 100)) == Capacity(10, 125)
    assert needed(int(OverflowType.NARROWPHASE), now, Capacity(12, 8)) == Capacity(20, 20)
    assert "njmax: 125 (now 20" in str(loss_error(int(OverflowType.NEFC), now, Capacity(10, 125)))
    assert "height field" in str(loss_error(int(OverflowType.HFIELD), now, now))


def landing(batch: WorldBatch) -> np.ndarray:
    """qvel after one env step of a plate that lies on the ground in world 0 and hangs in the air in the others."""
    qpos = np.tile(batch.mjm.qpos0, (batch.nworld, 1))
    qpos[0, 2] = 0.0495
    batch.data.qpos.assign(qpos.astype(np.float32))
    batch.data.qvel.zero_()
    batch.launch_step()
    return batch.data.qvel.numpy().copy()


def test_only_the_world_that_lost_rows_becomes_nan_and_its_rows_are_counted():
    batch = WorldBatch(studded_plate(), 3, 2, "cpu", capacity=Capacity(200, 64))
    qvel = landing(batch)
    assert np.isnan(qvel[0]).all()
    assert np.isfinite(qvel[1:]).all()
    assert batch.losses.any_lost()
    with pytest.raises(SimulationError, match=r"execution\.njmax: 320 \(now 64"):
        batch.raise_losses()
    batch.raise_losses()  # said once
    assert np.isfinite(landing(WorldBatch(studded_plate(), 3, 2, "cpu", capacity=Capacity(200, 320)))).all()


def test_contacts_are_pooled_so_their_loss_takes_every_world():
    batch = WorldBatch(studded_plate(), 3, 2, "cpu", capacity=Capacity(20, 320))  # 60 for the 64 of world 0
    assert np.isnan(landing(batch)).all()
    with pytest.raises(SimulationError, match=r"execution\.nconmax: 40 \(now 20"):
        batch.raise_losses()


def test_given_sizes_do_not_grow_and_others_do_up_to_the_bound():
    given = WorldBatch(studded_plate(), 1, 2, "cpu", capacity=Capacity(100, 64))
    landing(given)
    with pytest.raises(SimulationError, match="njmax"):
        given.larger()
    free = WorldBatch(studded_plate(), 1, 2, "cpu")
    assert free.growth(Capacity(10**6, 10**6)) == Capacity(320, 1280)


def test_batches_of_another_size_share_the_model():
    """What set_contact_pairs changed holds for copies too."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
        <body><freejoint/><geom name="ball" size=".1"/></body></worldbody>
        <contact><pair geom1="floor" geom2="ball"/></contact></mujoco>"""
    )
    batch = WorldBatch(model, 1, 1, "cpu")
    batch.set_contact_pairs({"friction": np.full((1, 5), 0.25)})
    assert batch.resized(7).model is batch.model
    np.testing.assert_allclose(batch.resized(7).model.pair_friction.numpy(), 0.25)


def test_taped_step_says_so_at_once_on_cpu():
    model = studded_plate()
    step = TapedStep(WorldBatch(model, 1, 2, "cpu", capacity=Capacity(100, 64)))
    low = model.qpos0.copy()
    low[2] = 0.0495
    state = WarpState(
        wp.array(low[None].astype(np.float32), device="cpu"),
        wp.zeros((1, model.nv), dtype=float, device="cpu"),
        wp.zeros((1, 0), dtype=float, device="cpu"),
    )
    with pytest.raises(SimulationError, match="njmax"):
        step(wp.zeros((1, model.nu), dtype=float, device="cpu"), state)


def test_mujoco_warp_counts_past_the_end():
    """`needed` relies on it: nefc tells how many rows there would have been."""
    model = studded_plate()
    data = mujoco.MjData(model)
    data.qpos[2] = 0.0495
    mujoco.mj_forward(model, data)
    m, d = mjw.put_model(model), mjw.make_data(model, nconmax=100, njmax=64)
    m.opt.warn_overflow = 0
    d.qpos.assign(data.qpos[None].astype(np.float32))
    mjw.step(m, d)
    assert int(d.nefc.numpy()[0]) == data.nefc == 256
