"""The states between control steps, which C MuJoCo repeats, and what is measured in them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.errors import SimulationError
from msk_ray.evaluate.measure import Bench, Request
from msk_ray.legs.config import PushConfig
from msk_ray.legs.gait import walk as command
from msk_ray.legs.gait.body import SIDES, Array, Motion, analyse, between, repeated
from msk_ray.legs.gait.cycles import strikes
from msk_ray.legs.gait.measure import contacts
from msk_ray.legs.gait.stick import one_stride
from msk_ray.shipped import shipped_folder
from msk_ray.training import SavedPolicy, load_policy
from msk_ray.visualize.recording import Recording, record

SUBSTEPS = 5
"""Of myoleg26: 4 ms of 20 ms."""
REQUEST = Request(worlds=2, steps=300)
QPOS, QVEL, ACT = 1e-5, 1e-3, 1e-6
"""Float32 leaves 1e-6 rad, 5e-5 rad/s and 2e-8 of a control step at the median, 5e-6, 4e-4 and 1e-7 at 99 %."""

SLIDER = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody><body><joint name="j" type="slide"/><geom size=".1" mass="2"/></body></worldbody>
  <actuator><general joint="j" dyntype="filter" dynprm="0.05" gainprm="3"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def policy() -> SavedPolicy:
    return load_policy(shipped_folder() / "policies" / "myoleg26.pt")


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench("cpu")


@pytest.fixture(scope="module")
def recording(bench: Bench, policy: SavedPolicy) -> Recording:
    return record(bench, policy, REQUEST)


def parts(recording: Recording, world: int) -> tuple[Motion, Array]:
    """The recorded states of an episode and its ctrl."""
    states = recording.world(world)
    return Motion(states.qpos, states.qvel, states.act), states.ctrl


def errors(model: mujoco.MjModel, recorded: Motion, ctrl: Array) -> list[Array]:
    """Largest error of qpos, qvel and act after each control step, each (C,)."""
    after = repeated(model, recorded, ctrl, SUBSTEPS)
    return [np.abs(last[:, -1] - start[1:]).max(1) for last, start in zip(after, recorded, strict=True)]


@pytest.mark.long
def test_every_control_step_ends_in_the_state_that_was_recorded(recording: Recording) -> None:
    model = recording.model
    for world in range(recording.count):
        recorded, ctrl = parts(recording, world)
        assert len(ctrl) == 301
        qpos, qvel, act = errors(model, recorded, ctrl)
        assert np.median(qpos) < 0.2 * QPOS
        assert np.median(qvel) < 0.2 * QVEL
        # About one step in 2000 has a contact that rounding opens or closes, which moves a foot by up to 0.03 rad and
        # 3 rad/s.
        assert np.mean((qpos > QPOS) | (qvel > QVEL)) < 0.02
        assert qpos.max() < 0.1
        assert qvel.max() < 10.0
        assert act.max() < ACT
        for shift in (-1, 1):
            wrong = errors(model, recorded, np.roll(ctrl, shift, axis=0))
            assert np.median(wrong[0]) > 100.0 * QPOS, "ctrl of another control step"
            assert np.median(wrong[1]) > 100.0 * QVEL


@pytest.mark.long
def test_substeps_are_set_between_the_recorded_states(recording: Recording) -> None:
    recorded, ctrl = parts(recording, 0)
    found = between(recording.model, recorded, ctrl, SUBSTEPS)
    assert [part.shape for part in found] == [(1501, 18), (1501, 18), (1501, 26)]
    after = repeated(recording.model, recorded, ctrl, SUBSTEPS)
    for part, start, substeps in zip(found, recorded, after, strict=True):
        np.testing.assert_array_equal(part[::SUBSTEPS], start)
        inside = part[:-1].reshape(300, SUBSTEPS, -1)[:, 1:]
        np.testing.assert_array_equal(inside, substeps[:, :-1])
    unused = ctrl.copy()
    unused[-1] = np.nan
    np.testing.assert_array_equal(between(recording.model, recorded, unused, SUBSTEPS).qpos, found.qpos)


@pytest.mark.long
def test_the_command_measures_at_substeps(
    bench: Bench, policy: SavedPolicy, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "record", lambda *_: recording)
    found = command.walk(bench, policy, REQUEST)
    assert len(found.episodes) == len(found.qpos) == 2
    for world, (episode, qpos) in enumerate(zip(found.episodes, found.qpos, strict=True)):
        assert episode.timestep == pytest.approx(0.004)
        assert len(qpos) == len(episode.forward) == len(episode.curves["vertical_force"]["l"]) == 1501
        np.testing.assert_array_equal(qpos[::SUBSTEPS], recording.world(world).qpos)
    assert 110.0 < found.gait["measures"]["cadence"]["value"] < 125.0
    # The strides of the film are those of the measures, at their samples.
    stride, seconds = one_stride(found.episodes, found.qpos)
    assert seconds == pytest.approx(2.0 * 60.0 / found.gait["measures"]["cadence"]["value"], rel=0.05)
    assert len(stride) == round(seconds / 0.004)


@pytest.mark.long
def test_a_strike_is_found_at_most_a_control_step_before_the_recorded_state_that_shows_it(recording: Recording) -> None:
    model, earlier = recording.model, []
    for world in range(recording.count):
        recorded, ctrl = parts(recording, world)
        rough = analyse(model, *recorded, recording.timestep)
        fine = analyse(model, *between(model, recorded, ctrl, SUBSTEPS), model.opt.timestep)
        for side in SIDES:
            late, early = SUBSTEPS * strikes(contacts(rough, side)), strikes(contacts(fine, side))
            assert len(late) == len(early) >= 4
            earlier += (late - early).tolist()
    assert min(earlier) >= 0
    assert max(earlier) < SUBSTEPS
    assert 1.0 < np.mean(earlier) < 3.0, "half a control step on average"


@pytest.mark.long
def test_pushes_are_repeated_and_steps_that_diverged_are_not(
    bench: Bench, policy: SavedPolicy, recording: Recording
) -> None:
    env = policy.config.env.model_copy(update={"push": PushConfig(speed=0.3, interval=0.2)})
    pushed = replace(policy, config=policy.config.model_copy(update={"env": env}))
    moved = record(bench, pushed, Request(worlds=1, steps=35))
    recorded, ctrl = parts(moved, 0)
    qvel = errors(moved.model, recorded, ctrl)[1]
    assert qvel[[9, 19, 29]].min() > 0.1, "the state after these steps is the one after a push"
    assert qvel[[10, 20, 30]].max() < 0.02, "which the next step begins with"
    states = command.every_substep(recording, 1, SUBSTEPS)
    assert len(states.qpos) == 1501
    ended = replace(recording, episodes=recording.episodes._replace(diverged=recording.episodes.diverged | True))
    np.testing.assert_array_equal(command.every_substep(ended, 1, SUBSTEPS).qpos, states.qpos[:-5])


@pytest.mark.long
def test_forces_from_outside_are_repeated(bench: Bench, policy: SavedPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    request = Request(worlds=1, steps=10)
    env = bench.evaluator(policy.config, request)[0].env
    monkeypatch.setattr(env, "applied_force", lambda state: 10.0 * torch.ones_like(state.qvel))
    pulled = record(bench, policy, request)
    recorded, ctrl = parts(pulled, 0)
    found = command.every_substep(pulled, 0, SUBSTEPS)
    with_forces, without = (
        between(pulled.model, recorded, ctrl, SUBSTEPS, force).qvel for force in (np.full((11, 18), 10.0), None)
    )
    np.testing.assert_array_equal(found.qvel, with_forces)
    assert np.abs(with_forces - without).max() > 0.1


def stepped(model: mujoco.MjModel, ctrl: Array, applied: Array, substeps: int) -> tuple[Motion, Motion]:
    """States of `mj_step` at the ends of control steps, and at all substeps."""
    data, rows = mujoco.MjData(model), []
    for u, force in zip(ctrl[:-1], applied[:-1], strict=True):
        data.ctrl[:], data.qfrc_applied[:] = u, force
        for _ in range(substeps):
            rows.append((data.qpos.copy(), data.qvel.copy(), data.act.copy()))
            mujoco.mj_step(model, data)
    rows.append((data.qpos.copy(), data.qvel.copy(), data.act.copy()))
    found = Motion(*(np.array(part) for part in zip(*rows, strict=True)))
    return Motion(*(part[::substeps] for part in found)), found


def test_substeps_are_those_of_mj_step_with_forces_from_outside() -> None:
    model = mujoco.MjModel.from_xml_string(SLIDER)
    ctrl, applied = np.array([[1.0], [-2.0], [0.5], [0.0]]), np.array([[30.0], [10.0], [-5.0], [0.0]])
    recorded, wanted = stepped(model, ctrl, applied, 4)
    found = between(model, recorded, ctrl, 4, applied)
    assert len(found.qpos) == 13
    for part, expected in zip(found, wanted, strict=True):
        np.testing.assert_allclose(part, expected, rtol=0.0, atol=1e-15)
    assert np.abs(between(model, recorded, ctrl, 4).qvel - wanted.qvel).max() > 0.1, "without the forces"


def test_what_has_nothing_between_is_returned() -> None:
    model = mujoco.MjModel.from_xml_string(SLIDER)
    ctrl = np.array([[1.0], [0.0]])
    recorded, _ = stepped(model, ctrl, ctrl, 1)
    assert between(model, recorded, ctrl, 1) is recorded
    alone = Motion(*(part[:1] for part in recorded))
    assert between(model, alone, ctrl[:1], 4) is alone


def test_an_episode_that_cannot_be_repeated_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(SLIDER)
    ctrl = np.zeros((4, 1))
    recorded, _ = stepped(model, ctrl, ctrl, 4)
    recorded.qvel[2] = 1e12
    with pytest.raises(SimulationError, match="C MuJoCo diverges in control step 2 of an episode"):
        between(model, recorded, ctrl, 4)
