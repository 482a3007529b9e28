"""The tracking task beyond mjlab's recorded steps: starts, ends, sampling of frames, future frames, gradients."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from slopes import check_slopes
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.config.environments import settings_class
from msk_ray.envs import make_env
from msk_ray.errors import ConfigError
from msk_ray.robots.tracking.env import G1Tracking
from msk_ray.robots.tracking.motions import Clip, read_motions
from msk_ray.robots.tracking.references import Library, References, StartFrames
from msk_ray.step import Simulation, StepState
from msk_ray.step.check.check import compare
from msk_ray.step.check.oracle import Oracle, Point
from msk_ray.step.check.pullback import simulated_gradients

STILL = {"reset_noise": 0.0, "reset_velocity_noise": 0.0}


def make(nworld: int, *, differentiable: bool = False, **changes: Any) -> G1Tracking:
    settings = settings_class("g1_tracking")(name="g1_tracking", **changes)
    env = make_env(settings, PhysicsConfig(), nworld, "cpu", 0, differentiable=differentiable)
    assert isinstance(env, G1Tracking)
    return env


def begin_at(env: G1Tracking, frames: list[int]) -> None:
    """Put the worlds into frames of the library, without noise."""
    first = torch.tensor(frames)
    last = env.references.lasts[torch.bucketize(first, env.references.lasts)]
    state = env.reset_state()._replace(physics=env._noisy(first), numbers=torch.stack((first, last), -1).float())
    env.state = env._begun(state)


def test_episodes_begin_near_the_drawn_frames_within_the_noise() -> None:
    env = make(1)
    physics, numbers = env.draw_start(2000)
    first, last = numbers.unbind(-1)
    assert (last == 199).all()
    assert first.min() < 5
    assert first.max() > 190
    reference = env.references.bodies(first.long())
    shift = physics.qpos[:, :3] - reference.position[:, 0]
    assert shift.abs().amax(0).tolist() == pytest.approx([0.05, 0.05, 0.01], abs=1e-3)
    rates = env.references.joints(first.long())[:, 29:]
    torch.testing.assert_close(physics.qvel[:, 6:], rates)
    exact = make(1, **STILL)
    physics, numbers = exact.draw_start(50)
    reference = exact.references.bodies(numbers[:, 0].long())
    torch.testing.assert_close(physics.qpos[:, :3], reference.position[:, 0])
    state = exact.state._replace(physics=physics)
    assert state.physics.qpos.shape == (50, 36)


def test_without_noise_a_world_begins_exactly_on_its_reference() -> None:
    """Poses and velocities of all bodies, by the kinematics of the simulation, are the reference's."""
    env = make(3, **STILL)
    begin_at(env, [0, 60, 150])
    deviation = env.deviation(env.state.physics)
    for part in deviation:
        assert part.abs().max() < 2e-3
    torch.testing.assert_close(env.reference_qpos(), env.state.physics.qpos, atol=1e-5, rtol=0.0)
    assert not env.fell(env.state.physics).any()


def test_the_reference_advances_with_age_and_an_episode_ends_with_its_clip() -> None:
    env = make(2, **STILL, action_about="reference")
    begin_at(env, [40, 197])
    for step in range(3):
        assert env.frame().tolist() == [40 + step, 197 + step]
        transition = env.step(torch.zeros(2, 29), auto_reset=False)
        torch.testing.assert_close(transition.obs, env.observation())
        torch.testing.assert_close(transition.obs[0, :58], env.references.joints(torch.tensor([41 + step]))[0])
        assert transition.truncated.tolist() == [False, step == 2]
    assert env.frame().tolist() == [43, 199]


def test_spreading_ages_leaves_the_reference_in_place() -> None:
    env = make(16, **STILL)
    before = env.frame()
    env.spread_ages()
    assert env.state.age.max() > 400
    assert torch.equal(env.frame(), before)
    assert not env.step(torch.zeros(16, 29)).terminated.any()


def test_uniform_starts_are_anywhere() -> None:
    lengths = (250, 100)
    library = Library(("a", "b"), lengths, torch.zeros(350, 58), torch.zeros(350, 14, 13))
    starts = StartFrames(References(library, 0, torch.device("cpu")), 50.0, "uniform")
    assert len(starts.failures) == 6 + 3
    uniform = torch.rand(20000, 2, generator=torch.Generator().manual_seed(0))
    first, last = starts.draw(uniform)
    assert set(last.tolist()) == {249, 349}
    assert (first <= last).all()
    assert (first < 250).float().mean() == pytest.approx(250 / 350, abs=0.02)
    # Of two worlds, the one in frame 252, among the first frames of clip b, fails: that is the first bin of b.
    starts.count(starts.tally(torch.tensor([252, 10]), torch.tensor([True, False])))
    assert starts.failures.tolist() == pytest.approx([0.0] * 6 + [0.001, 0.0, 0.0])
    assert starts.visits.tolist() == pytest.approx([0.001] + [0.0] * 5 + [0.001, 0.0, 0.0])
    # A bin of clip b has a third of its 99 of all 249 + 99 steps between frames, failures or not.
    assert starts.chances()[6] == pytest.approx((99 / 3) / (249 + 99))


def test_starts_by_the_failure_rate_lie_up_to_two_bins_before_the_failures() -> None:
    library = Library(("a", "b"), (150, 100), torch.zeros(250, 58), torch.zeros(250, 14, 13))
    starts = StartFrames(References(library, 0, torch.device("cpu")), 50.0, "failure_rate")
    # Bins of a begin at frames 0, 37, 74, 111, those of b at 150, 183, 216; each is as wide as the others of its clip.
    share = torch.tensor([149 / 4] * 4 + [99 / 3] * 3) / 248
    torch.testing.assert_close(starts.chances(), share)
    # Of five worlds, two are in the last bin of a, and one of them fails there; one is in the second of b.
    frames = torch.tensor([120, 121, 1, 2, 190])
    starts.count(starts.tally(frames, torch.tensor([True, False, False, False, False])))
    # Failures per visit: one of five in all, and 5/7 world per bin; so (1 + 1/7) / (2 + 5/7) in that bin, 1/7 over 2 +
    # 5/7, 1 + 5/7 and 5/7 in bins that two, one or no world visited.
    rates = torch.tensor([1 / 19, 1 / 5, 1 / 5, 8 / 19, 1 / 5, 1 / 12, 1 / 5])
    torch.testing.assert_close(starts.failure_rates(), rates)
    # Means of each bin and the next two of its clip, of which the last one counts again.
    ahead = torch.tensor([[0, 1, 2], [1, 2, 3], [2, 3, 3], [3, 3, 3], [4, 5, 6], [5, 6, 6], [6, 6, 6]])
    chances = share * rates[ahead].mean(1)
    torch.testing.assert_close(starts.chances(), chances / chances.sum())


def test_steps_count_failures_and_checkpoints_keep_them() -> None:
    env = make(4, **STILL)
    begin_at(env, [0, 60, 120, 180])
    lying = env.state.physics.qpos.clone()
    lying[1, 2] -= 0.4
    env.state = env.state._replace(physics=env.state.physics._replace(qpos=lying))
    assert env.step(torch.zeros(4, 29)).terminated.tolist() == [False, True, False, False]
    assert env.start_frames.failures.nonzero().flatten().tolist() == [1]
    other = make(4, **STILL)
    other.load_state_dict(env.state_dict())
    assert torch.equal(other.start_frames.failures, env.start_frames.failures)
    assert torch.equal(other.start_frames.visits, env.start_frames.visits)
    assert torch.equal(other.frame(), env.frame())
    saved = {**env.state_dict(), "failures": torch.zeros(7)}
    with pytest.raises(ConfigError, match="have changed since this trial was saved"):
        other.load_state_dict(saved)


def test_scored_episodes_begin_without_noise_at_the_first_frame_of_a_clip(tmp_path: Path) -> None:
    model = make(1).model
    (motion,) = read_motions("builtin:squat", model)
    for name, end in (("a", 2.0), ("b", 4.0)):
        Clip.of(motion.at_rate(50.0).cut(0.0, end - 0.02), model).save(tmp_path / f"{name}.npz")
    trained = settings_class("g1_tracking")(
        name="g1_tracking", motion=str(tmp_path), score_sampling="start", score_failure="pelvis", reward={"tail": 1.0}
    )
    scored = G1Tracking.reference_settings(trained)
    assert (scored.sampling, scored.failure, scored.reward.tail) == ("start", "pelvis", 0.0)
    env = make_env(scored, PhysicsConfig(), 4, "cpu", 0, differentiable=False)
    assert isinstance(env, G1Tracking)
    assert env.references.lengths == (100, 200)
    for _ in range(2):
        env.state = env.reset_state()
        assert env.frame().tolist() == [0, 100, 0, 100]
        assert env.deviation(env.state.physics).position.abs().max() < 1e-4
    mirrored = make(1, motion=str(tmp_path), mirror=True)
    assert mirrored.references.names == ("a", "a mirrored", "b", "b mirrored")


def test_an_action_of_zero_about_the_reference_asks_for_its_joint_angles() -> None:
    env = make(1, **STILL, action_about="reference", action_range=2.0)
    begin_at(env, [100])
    targets = env.control(torch.zeros(1, 29))[0]
    reference_angles = env.references.joints(torch.tensor([100]))[0, :29]
    torch.testing.assert_close(targets, reference_angles[env._joint_of_servo])
    terms = env.step(torch.zeros(1, 29), auto_reset=False).terms[0]
    assert abs(float(terms[env.reward_names.index("action_rate_l2")])) < 0.1


def test_future_frames_follow_the_rest_of_the_observation() -> None:
    plain, ahead = make(2, **STILL), make(2, **STILL, future_frames=[1, 50])
    for env in (plain, ahead):
        begin_at(env, [10, 180])
    obs, more = plain.observation(), ahead.observation()
    torch.testing.assert_close(more[:, :160], obs)
    assert more.shape[1] == ahead.obs_size == 160 + 2 * 67 == len(ahead.observation_layout())
    later = ahead.references.joints(torch.tensor([60, 199]))
    torch.testing.assert_close(more[:, 160 + 67 : 160 + 67 + 58], later)


def test_a_tail_adds_a_share_of_the_reciprocal_to_motion_terms() -> None:
    plain, tailed = make(1, **STILL), make(1, **STILL, reward={"tail": 0.5})
    values = []
    for env in (plain, tailed):
        begin_at(env, [0])
        far = env.state.physics.qpos.clone()
        far[:, 0] += 0.6
        env.next_memory = env.memory
        state = env.state.physics._replace(qpos=far)
        values.append(float(env.active_terms[0].measure(env, state, state.qpos, state.qpos)))
    assert values[0] == pytest.approx(np.exp(-4.0), rel=1e-3)
    assert values[1] == pytest.approx(0.5 * np.exp(-4.0) + 0.5 / 5.0, rel=1e-3)


def test_far_from_the_torsos_place_a_training_episode_ends_but_a_scored_one_goes_on() -> None:
    env = make(3, **STILL, drift_limit=0.5)
    begin_at(env, [0, 0, 0])
    qpos = env.state.physics.qpos.clone()
    qpos[1, :2] += torch.tensor([0.3, 0.35])  # 0.46 m
    qpos[2, :2] += torch.tensor([0.4, 0.35])  # 0.53 m
    moved = env.state.physics._replace(qpos=qpos)
    assert env.fell(moved).tolist() == [False, False, True]
    scored = env.reference_settings(env.config)
    assert scored.drift_limit is None
    unlimited = make(3, **STILL)
    begin_at(unlimited, [0, 0, 0])
    assert not unlimited.fell(moved).any()


def test_unknown_motions_and_empty_cuts_are_refused() -> None:
    with pytest.raises(ConfigError, match="no motion 'nowhere'"):
        make(1, motion="nowhere")
    with pytest.raises(ValueError, match=r"2 to 1 s is no part of a motion"):
        make(1, cut=(2.0, 1.0))


def test_gradients_of_reward_and_observation_match_finite_differences() -> None:
    env = make(1, **STILL, reward={"tail": 0.5}, future_frames=[2])
    begin_at(env, [60])
    rng = np.random.default_rng(3)
    parts = [part[0].numpy().astype(float) for part in env.state.physics[:2]]
    parts[0][3:7] += 0.1 * rng.normal(size=4)
    parts[0][3:7] /= np.linalg.norm(parts[0][3:7])
    parts[0][7:] += 0.03 * rng.normal(size=env.action_size)
    parts[1] += 0.3 * rng.normal(size=parts[1].size)
    action = torch.zeros(1, env.action_size)
    weights = torch.tensor(rng.normal(size=env.critic_size + env.obs_size), dtype=torch.float32)
    env.measurements.ignore_contact_forces = True

    def value(arrays: list[Tensor]) -> Tensor:
        state = StepState(*arrays, env.state.physics.act)
        env.next_memory = dict(env.remember(state, action))
        obs, seen = env.observe(state, action), env.observe_critic(state, action)
        remembered = env.next_memory["anchor"].square().sum()
        return (torch.cat((obs, seen), -1) * weights).sum() + env.reward_terms(state, action, obs).sum() + remembered

    check_slopes(value, parts, rng)


def test_the_gradient_of_a_step_from_a_frame_matches_float64_differences() -> None:
    env = make(1, **STILL)
    physics = env._noisy(torch.tensor([60]))
    qpos, qvel = (part[0].numpy().astype(np.float64) for part in physics[:2])
    qpos[2] -= 0.006  # pressed on the ground
    ctrl = env.control(torch.zeros(1, 29))[0].numpy().astype(np.float64)
    point = Point(ctrl=ctrl, qpos=qpos.astype(np.float32).astype(np.float64), qvel=qvel, act=np.zeros(0))
    cotangent = np.random.default_rng(0).standard_normal((1, 70)).astype(np.float32).astype(np.float64)
    oracle = Oracle(env.model, 4)
    assert oracle.touching(point)
    reference = oracle.linearize(point)
    assert not reference.at_kink(1e-3, 1e-2)
    _, gradients = simulated_gradients(Simulation(env.model, 1, 4, tolerance=1e-9), [point], cotangent, ())
    for key, expected in reference.pull_back(cotangent[0]).items():
        if expected.size:
            error, *_ = compare(gradients[key][0], expected, float(np.linalg.norm(cotangent)))
            assert error < 2e-3, key
