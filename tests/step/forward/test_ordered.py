"""Steps and pullbacks whose contacts and rows come in any order are the same to the last bit."""

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from msk_ray.errors import UnsupportedModelError
from msk_ray.step import TapePerSubstep
from msk_ray.step.forward import Kernels, WorldBatch
from msk_ray.step.forward.arrays import gather
from msk_ray.step.forward.ordered.contacts import ContactOrder, ContactRecords
from msk_ray.step.forward.ordered.rows import RowOrder, RowRecords
from msk_ray.step.forward.ordered.stages import OrderedStages

WORLDS = 3
TEXT = """
<mujoco>
  <option timestep="0.005" cone="{cone}" jacobian="{jacobian}"/>
  <default><geom condim="3" friction="0.8 0.1 0.1"/></default>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.3"><freejoint/><geom type="sphere" size="0.2"/>
      <body pos="0.25 0 -0.1"><joint name="a" axis="0 1 0" limited="true" range="-5 5" frictionloss="0.1"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0.3 0 -0.1"/></body>
      <body pos="-0.25 0 -0.1"><joint name="b" axis="0 1 0" limited="true" range="-5 5" frictionloss="0.1"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 -0.3 0 -0.1"/></body>
    </body>
    <body pos="0.1 0.35 0.2"><freejoint/><geom type="sphere" size="0.21"/></body>
  </worldbody>
  <equality><joint joint1="a" joint2="b" solref="0.05 1"/></equality>
  <tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="-0.5"/></fixed></tendon>
  <actuator><motor joint="a"/><motor joint="b"/><motor tendon="t"/></actuator>
</mujoco>
"""


def model(cone: str, jacobian: str = "dense") -> mujoco.MjModel:
    """Two bodies that lie on the floor and on each other, with rows of every kind."""
    return mujoco.MjModel.from_xml_string(TEXT.format(cone=cone, jacobian=jacobian))


def shuffled(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """Let contacts, and blocks of rows of one kind, come in an order that `seed` draws, as where threads race."""
    rng = np.random.default_rng(seed)
    sort_contacts, sort_rows = ContactOrder.launch, RowOrder.launch

    def permute(arrays: list[Any], order: np.ndarray, world: int | None = None) -> None:
        for array in arrays:
            values = array.numpy().copy()
            part = values if world is None else values[world]
            part[: len(order)] = part[order]
            array.assign(values)

    def contacts(self: ContactOrder, data: Any) -> None:
        fields = gather(ContactRecords, data.contact)
        permute([getattr(fields, n) for n in ContactRecords.vars], rng.permutation(int(data.nacon.numpy()[0])))
        sort_contacts(self, data)

    def rows(self: RowOrder, data: Any) -> None:
        for world in range(data.nworld):
            count = int(data.nefc.numpy()[world])
            kinds, ids = (getattr(data.efc, n).numpy()[world, :count] for n in ("type", "id"))
            blocks: dict[tuple[int, int], list[int]] = {}
            for row in range(count):
                blocks.setdefault((min(int(kinds[row]), 5), int(ids[row])), []).append(row)
            keys = [
                k
                for kind in sorted({k for k, _ in blocks})
                for k in rng.permutation([b for b in blocks if b[0] == kind])
            ]
            order = np.array([row for key in keys for row in blocks[tuple(int(x) for x in key)]], dtype=int)
            permute([getattr(data.efc, n) for n in (*RowRecords.vars, "J")], order, world)
            place = {int(old): new for new, old in enumerate(order)}
            address, owner = data.contact.efc_address.numpy().copy(), data.contact.worldid.numpy()
            for con in range(int(data.nacon.numpy()[0])):
                if owner[con] == world:
                    address[con] = [place[a] if a >= 0 else a for a in address[con]]
            data.contact.efc_address.assign(address)
        sort_rows(self, data)

    monkeypatch.setattr(ContactOrder, "launch", contacts)
    monkeypatch.setattr(RowOrder, "launch", rows)


def start(batch: WorldBatch) -> None:
    """Put states into the batch that touch and slide."""
    rng = np.random.default_rng(0)
    data, mjm = batch.data, batch.mjm
    worlds = batch.nworld
    qpos = np.tile(mjm.qpos0, (worlds, 1))
    qpos[:, [2, 11]] -= 0.102, 0.0
    data.qpos.assign(qpos.astype(np.float32))
    data.qvel.assign(rng.normal(size=(worlds, mjm.nv)).astype(np.float32))
    data.ctrl.assign(rng.normal(size=(worlds, mjm.nu)).astype(np.float32))


def stepped(batch: WorldBatch, steps: int = 6) -> list[bytes]:
    """The bits of the state after some steps, and of what a pullback through the last one gives."""
    start(batch)
    data = batch.data
    for _ in range(steps):
        batch.launch_substep(data, 0)
    tape = TapePerSubstep()
    tape.attach(batch)
    start(batch)
    for _ in range(steps):
        batch.launch_substep(data, 0)
    tape.launch_step(batch)
    assert np.mean(data.nefc.numpy()) >= 6
    generator = torch.Generator().manual_seed(0)
    for view in tape.cotangent:
        view.copy_(torch.randn(view.shape, generator=generator))
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    tape.launch_backward()
    wp.synchronize()
    arrays = [data.qpos, data.qvel, data.qacc, data.efc.force, data.contact.dist]
    gradients = [view.cpu().numpy() for view in tape.cotangent]
    return [np.array(a.numpy()).tobytes() for a in arrays] + [g.tobytes() for g in gradients]


@pytest.fixture(params=["elliptic", "pyramidal"], scope="module")
def cone(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize("fused", [False, True])
def test_any_order_of_contacts_and_rows_gives_the_same_bits(
    cone: str, fused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def bits() -> list[bytes]:
        with wp.ScopedDevice("cpu"):
            return stepped(WorldBatch(model(cone), WORLDS, 1, "cpu", kernels=Kernels(True, fused)))

    plain = bits()
    for seed in (1, 2):
        with monkeypatch.context() as patch:
            shuffled(patch, seed)
            assert bits() == plain


def test_a_shuffle_matters_where_nothing_is_sorted(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in (ContactOrder, RowOrder):
        monkeypatch.setattr(kind, "launch", lambda self, data: None)

    def run(seed: int) -> list[bytes]:
        with monkeypatch.context() as patch:
            shuffled(patch, seed)
            return stepped(WorldBatch(model("elliptic"), WORLDS, 1, "cpu", kernels=Kernels(ordered=True)))

    assert run(1) != run(2)


def test_the_ordered_step_is_that_of_the_package(cone: str) -> None:
    def run(ordered: bool) -> list[np.ndarray]:
        batch = WorldBatch(model(cone), WORLDS, 1, "cpu", kernels=Kernels(ordered=ordered))
        start(batch)
        for _ in range(10):
            batch.launch_substep(batch.data, 0)
        return [np.array(a.numpy()) for a in (batch.data.qpos, batch.data.qvel, batch.data.qacc)]

    for ours, theirs in zip(run(True), run(False), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=2e-4, atol=2e-4)


@pytest.mark.gpu
@pytest.mark.parametrize("fused", [False, True])
def test_a_gpu_repeats_steps_and_their_gradients(cone: str, fused: bool) -> None:
    worlds = 2048

    def run() -> list[bytes]:
        with wp.ScopedDevice("cuda:0"):
            return stepped(WorldBatch(model(cone), worlds, 1, "cuda:0", kernels=Kernels(True, fused)), steps=30)

    assert run() == run()


def test_the_example_finds_nothing_unordered_on_a_cpu(
    root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if wp.is_cuda_available():
        pytest.skip("it shows on a GPU what is unordered there")
    monkeypatch.setattr(sys, "argv", ["unordered.py", "16"])
    runpy.run_path(str(root / "docs" / "examples" / "unordered.py"))
    lines = capsys.readouterr().out.splitlines()
    assert "contacts: up to 0 of 128 contacts differ" in lines
    assert "constraint rows: up to 0 of 16 worlds differ" in lines


@pytest.mark.parametrize(
    ("change", "races"),
    [
        (lambda text: text, set()),
        (lambda text: text.replace('<fixed name="t"', '<fixed name="t" stiffness="1"'), {"velocity"}),
        (lambda text: text.replace('name="a"', 'name="a" actuatorfrcrange="-1 1"'), {"actuation"}),
        (lambda text: text.replace("<option", '<option integrator="implicitfast"'), {"integration"}),
    ],
)
def test_atomics_get_an_order_where_threads_meet(change: Callable[[str], str], races: set[str]) -> None:
    mjm = mujoco.MjModel.from_xml_string(change(TEXT).format(cone="elliptic", jacobian="dense"))
    batch = WorldBatch(mjm, 1, 1, "cpu", kernels=Kernels(ordered=True))
    assert isinstance(batch.stages, OrderedStages)
    assert batch.stages.racing == races
    assert bool(batch.stages.summing(batch.model).opt.deterministic) is bool(races)


def wrapped_tendons() -> mujoco.MjModel:
    """An arm with two tendons over sites, around a cylinder and through a pulley, and one of joints."""
    return mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody>
          <site name="s0" pos="0 0 0.05"/><site name="p0" pos="0.1 0 0.1"/>
          <body pos="0 0 0"><joint name="a" axis="0 1 0"/><geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/>
            <site name="s1" pos="0.2 0 0.04"/><site name="p1" pos="0.15 0.02 0.03"/>
            <body pos="0.3 0 0"><joint name="b" axis="0 1 0"/>
              <geom name="wrap" type="cylinder" size="0.03 0.1" euler="90 0 0" pos="0 0 0"/>
              <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/>
              <site name="s2" pos="0.1 0 0.04"/><site name="s3" pos="0.2 0 0.04"/><site name="p2" pos="0.1 0.02 0.03"/>
            </body></body></worldbody>
          <tendon>
            <spatial name="one"><site site="s0"/><site site="s1"/><geom geom="wrap"/><site site="s2"/>
              <site site="s3"/></spatial>
            <spatial name="two"><site site="p0"/><site site="p1"/><pulley divisor="2"/><site site="p1"/>
              <site site="p2"/></spatial>
            <fixed name="three"><joint joint="a" coef="1"/><joint joint="b" coef="-0.5"/></fixed>
          </tendon></mujoco>"""
    )


def test_tendons_are_those_of_the_package_and_elements_of_one_never_meet() -> None:
    mjm = wrapped_tendons()

    def lengths(ordered: bool) -> list[np.ndarray]:
        batch = WorldBatch(mjm, WORLDS, 1, "cpu", kernels=Kernels(ordered=ordered))
        rng = np.random.default_rng(0)
        batch.data.qpos.assign(rng.uniform(-0.5, 0.5, size=(WORLDS, mjm.nq)).astype(np.float32))
        mjw.kinematics(batch.model, batch.data)
        mjw.com_pos(batch.model, batch.data)
        batch.stages.tendon(batch.model, batch.data)
        return [np.array(batch.data.ten_length.numpy()), np.array(batch.data.ten_J.numpy())]

    for one, other in zip(lengths(True), lengths(False), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
    batch = WorldBatch(mjm, 1, 1, "cpu", kernels=Kernels(ordered=True))
    assert isinstance(batch.stages, OrderedStages)
    assert batch.stages._tendons is not None
    model, parts = batch.model, batch.stages._tendons._parts
    assert len(parts) == 2
    for kind, count in (("jnt", 2), ("site_pair", 4), ("geom", 1)):
        tendons = [getattr(part, f"tendon_{kind}_adr").numpy() for part in parts]
        assert all(len(set(some)) == len(some) for some in tendons)
        places = np.concatenate([getattr(part, f"wrap_{kind}_adr").numpy() for part in parts])
        assert sorted(places) == sorted(getattr(model, f"wrap_{kind}_adr").numpy())
        assert len(places) == count


def driven_arm() -> mujoco.MjModel:
    """An arm under implicitfast with a servo, a damper and muscles, two of which share its joints."""
    text = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
        <site name="s0" pos="0 0 0.05"/>
        <body><joint name="a" axis="0 1 0" damping="0.1"/><geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/>
          <body pos="0.3 0 0"><joint name="b" axis="0 1 0"/><geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/>
            <site name="s1" pos="0.1 0 0.04"/>
            <body pos="0.3 0 0"><joint name="c" axis="0 0 1"/><geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0"/>
            </body></body></body>
        <body pos="0 1 0"><joint name="d" axis="0 1 0"/><geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/></body>
      </worldbody>
      <tendon><spatial name="t"><site site="s0"/><site site="s1"/></spatial>
        <fixed name="f"><joint joint="c" coef="0.1"/><joint joint="d" coef="-0.2"/></fixed></tendon>
      <actuator><position joint="a" kp="20" kv="3"/><muscle tendon="t" force="50"/><damper joint="b" kv="2"
        ctrlrange="0 1"/><position tendon="f" kp="5" kv="4"/><motor joint="d"/></actuator></mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


def test_actuators_add_to_the_implicit_matrix_in_their_order() -> None:
    """The package's matrix, step and pullback but for rounding, and no thread that meets another."""
    mjm = driven_arm()

    def run(ordered: bool) -> list[np.ndarray]:
        batch = WorldBatch(mjm, WORLDS, 1, "cpu", kernels=Kernels(ordered=ordered))
        assert not batch.stages.summing(batch.model).opt.deterministic
        tape = TapePerSubstep()
        tape.attach(batch)
        rng, data = np.random.default_rng(0), batch.data
        data.qpos.assign(rng.uniform(-0.5, 0.5, size=(WORLDS, mjm.nq)).astype(np.float32))
        data.qvel.assign(rng.normal(size=(WORLDS, mjm.nv)).astype(np.float32))
        data.ctrl.assign(rng.uniform(0.1, 1.0, size=(WORLDS, mjm.nu)).astype(np.float32))
        data.act.assign(rng.uniform(0.1, 1.0, size=(WORLDS, mjm.na)).astype(np.float32))
        mjw.forward(batch.model, data)
        out = wp.zeros((WORLDS, batch.model.nC), dtype=float, device="cpu")
        batch.stages.slopes(batch.model, data, out)
        tape.launch_step(batch)
        for view in tape.cotangent:
            view.copy_(torch.linspace(-1.0, 1.0, view.numel()).view(view.shape))
        tape.launch_backward()
        inertia = np.array(data.M.numpy())
        return [
            np.array(out.numpy()),
            inertia,
            *(v.numpy().copy() for v in tape.cotangent),
            data.qvel.numpy(),
            data.act.numpy(),
        ]

    ours, theirs = run(True), run(False)
    assert np.abs(theirs[0] - theirs[1]).max() > 0.05 * np.abs(theirs[1]).max()
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * float(np.abs(other).max()))


def test_a_sparse_jacobian_is_made_dense() -> None:
    mjm = model("elliptic", "sparse")
    batch = WorldBatch(mjm, 1, 1, "cpu", kernels=Kernels(ordered=True))
    assert not batch.model.is_sparse
    assert mjm.opt.jacobian == mujoco.mjtJacobian.mjJAC_SPARSE


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda m: setattr(m.opt, "integrator", mujoco.mjtIntegrator.mjINT_RK4), "RK4"),
        (lambda m: setattr(m.opt, "solver", mujoco.mjtSolver.mjSOL_CG), "solver"),
        (lambda m: setattr(m.opt, "noslip_iterations", 2), "noslip"),
    ],
)
def test_what_has_no_order_is_refused(change: Callable[[mujoco.MjModel], None], named: str) -> None:
    mjm = model("elliptic")
    change(mjm)
    with pytest.raises(UnsupportedModelError, match=f"{named}.*execution.deterministic=false"):
        WorldBatch(mjm, 1, 1, "cpu", kernels=Kernels(ordered=True))
