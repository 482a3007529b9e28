"""`myosuite_walk` against recorded steps of MyoSuite's own environment, and its gradients against float64 C MuJoCo."""

import importlib.util
import json
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from myosuite_model import walk_model
from slopes import check_slopes

from msk_ray.config import PhysicsConfig, load_config
from msk_ray.envs import make_env
from msk_ray.envs.records import EnvState
from msk_ray.errors import ConfigError
from msk_ray.legs.gait.__main__ import main as gait
from msk_ray.legs.myosuite_walk.config import MyoSuiteWalkReward, MyoSuiteWalkSettings
from msk_ray.legs.myosuite_walk.env import MyoSuiteWalk
from msk_ray.legs.myosuite_walk.model import KEYFRAMES, build_myosuite_walk
from msk_ray.legs.myosuite_walk.source import find_file
from msk_ray.step import Simulation, StepState, check_gradients
from msk_ray.step.autograd.tangent import quat_multiply
from msk_ray.training import Trainer

pytestmark = pytest.mark.long

RECORDED = Path(__file__).parents[1] / "fixtures" / "myosuite_walk"


def settings(**changes: Any) -> MyoSuiteWalkSettings:
    return MyoSuiteWalkSettings(name="myosuite_walk", model=walk_model(), **changes)


def make(nworld: int, device: str = "cpu", **changes: Any) -> MyoSuiteWalk:
    env = make_env(settings(**changes), PhysicsConfig(), nworld, device, 0, differentiable=False)
    assert isinstance(env, MyoSuiteWalk)
    return env


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def test_episodes_are_those_of_myosuite(device: str) -> None:
    """100 random steps in four episodes, free-running from their initial states: contact, muscles, falls, phase."""
    recorded = np.load(RECORDED / "steps.npz")
    steps = {name: torch.as_tensor(recorded[name], device=device) for name in recorded if name != "versions"}
    starts = torch.nonzero(steps["age"] == 0).flatten()
    lengths = torch.diff(starts, append=torch.tensor([100], device=device)).tolist()
    env = make(len(starts), device, smoothing=0.0)
    physics = StepState(*(steps[name][starts] for name in ("qpos", "qvel", "act")))
    none = torch.zeros((len(starts), 0), device=device)
    env.state = EnvState(physics, torch.zeros_like(steps["action"][starts]), torch.zeros_like(starts), none)
    seen = 0
    for step in range(max(lengths)):
        running = [w for w, length in enumerate(lengths) if step < length]
        at = (starts + step).clamp_max(99)
        torch.testing.assert_close(env.observation()[running], steps["obs_before"][at[running]], atol=1e-3, rtol=0.0)
        found = env.step(steps["action"][at], auto_reset=False)
        for ours, theirs in ((found.obs, "obs"), (found.reward, "reward"), (found.terms, "terms")):
            torch.testing.assert_close(ours[running], steps[theirs][at[running]], atol=1e-3, rtol=0.0)
        assert torch.equal(found.terminated[running], steps["terminated"][at[running]])
        seen += len(running)
    assert seen == 100
    assert steps["terminated"].sum() >= 2


def test_resets_are_those_of_myosuite() -> None:
    steps = np.load(RECORDED / "steps.npz")
    env = make(2)
    assert env.state.physics.qpos.numpy() == pytest.approx(np.stack([steps["qpos"][0]] * 2), abs=1e-6)
    assert env.state.physics.qvel.numpy() == pytest.approx(np.stack([steps["qvel"][0]] * 2), abs=1e-6)
    assert not env.state.physics.act.any()
    knee = env.model.joint("knee_angle_r").qposadr[0]
    drawn = make(1, reset="random").draw_physics(4000)
    bent = drawn.qpos[:, knee] > 0.6
    assert 0.45 < bent.float().mean() < 0.55, "as often the mirror image"
    noise = drawn.qpos[bent] - torch.tensor(env.model.key(KEYFRAMES[2]).qpos, dtype=torch.float32)
    assert noise[:, 2].abs().max() < 1e-6, "except the height"
    spread = noise.std(0)
    assert spread[[0, 1, *range(3, 35)]].numpy() == pytest.approx(0.02, rel=0.1), "the quaternion has noise too"
    fixed = make(1, reset="random", stochastic_reset=False).draw_physics(3).qpos
    assert torch.equal(fixed, env.draw_physics(3).qpos)
    standing = make(1, reset="none").draw_physics(1)
    assert standing.qpos[0, 2].item() == pytest.approx(0.92)
    assert not standing.qvel.any()


def test_episodes_may_start_anywhere_in_the_cycle_of_people() -> None:
    """The hips are where the reward wants them, as far as people's reach."""
    env = make(64, reset="random", cycle=0.5, reward={"footfall": 1.0, "clearance": 1.0})
    q, v, act = env.state.physics
    ahead = env.task_numbers(env.state.numbers)[:, 0]
    elsewhere = act[:, 0] > 0.0
    assert 0.3 < elsewhere.float().mean() < 0.7
    assert not ahead[~elsewhere].any()
    assert ahead.unique().numel() > 16
    wanted = torch.cos(2.0 * torch.pi * ahead[elsewhere] / 100.0)
    right, left = (q[elsewhere, env.model.joint(f"hip_flexion_{side}").qposadr[0]] for side in "rl")
    assert torch.corrcoef(torch.stack((wanted, right, -left)))[0].min() > 0.95
    assert -v[elsewhere, 1].mean() == pytest.approx(1.2, abs=1e-3)
    assert torch.equal(env.observation()[:, 2 + 33 + 34 + 4 + 2 + 1 + 6], ahead / 100.0)
    terms = env.step(torch.zeros(64, 80)).terms[:, -2:]
    assert (terms[elsewhere] <= 0.0).all()
    assert terms[elsewhere].mean(0)[0] > -0.5, "people's feet stand still when they are on the ground"
    assert not make(2, cycle=1.0, stochastic_reset=False).state.physics.act.any()
    assert settings(cycle=1.0, stochastic_reset=False).unread()["cycle"] == "env.stochastic_reset is false"


def test_springs_turn_the_pelvis_to_standing_and_fade() -> None:
    env = make(2, reset="none", assist={"epochs": 4, "steady": 0.5})
    q, v, act = env.state.physics
    # The right world is 10 cm aside, and turned by 0.1 rad about the vertical.
    turn = torch.tensor([np.cos(0.05), 0.0, 0.0, np.sin(0.05)], dtype=torch.float32)
    q[1, 3:7] = quat_multiply(turn[None], q[1:, 3:7])[0]
    q[1, 0] += 0.1
    force = env.applied_force(StepState(q, v, act))
    assert force is not None
    assert force[0].numpy() == pytest.approx(np.zeros(34), abs=1e-4)
    assert force[1].numpy() == pytest.approx([-80.0, 0.0, 0.0, 0.0, 0.0, -9.714, *[0.0] * 28], abs=1e-2)
    assert env.end_epoch(49.0) == {"train/assist": 1.0}
    assert env.end_epoch(51.0) == {"train/assist": 1.0}
    env.enter_epoch(2)
    assert env.applied_force(StepState(q, v, act))[1, 0].item() == pytest.approx(-60.0)  # type: ignore[index]
    assert env.state_dict()["assist_epochs"] == 1


def test_a_symmetric_policy_does_with_the_left_leg_what_it_did_with_the_right() -> None:
    """Mirror images of a state, half a cycle apart, look the same, and the same actions lead to mirror images."""
    env = make(2, reset="random", symmetric=True, cycle=1.0)
    reset = make(1, reset="init", stochastic_reset=False).state.physics
    left = [part.clone() for part in reset]
    left[0][:, 3:7] = torch.tensor([[0.70, 0.02, -0.03, -0.71]])
    left[1][0, :6] = torch.tensor([0.1, -1.0, 0.2, 0.3, -0.4, 0.5])
    left[2][0] = torch.rand(80, generator=torch.Generator().manual_seed(1))
    qpos, qvel, act = (part.clone() for part in left)
    qpos[:, 3:7] = torch.stack((-left[0][:, 6], left[0][:, 5], left[0][:, 4], -left[0][:, 3]), dim=-1)
    qvel[:, :6] *= torch.tensor([-1.0, 1.0, 1.0, -1.0, 1.0, -1.0])
    signs = torch.ones(14)
    signs[[3, 7]] = -1.0
    for mirrored, own, first in ((qpos, left[0], 7), (qvel, left[1], 6)):
        mirrored[:, first : first + 14] = own[:, first + 14 :] * signs
        mirrored[:, first + 14 :] = own[:, first : first + 14] * signs
    act = torch.cat((act[:, 40:], act[:, :40]), dim=-1)
    physics = StepState(*(torch.cat(pair) for pair in zip(left, (qpos, qvel, act), strict=True)))
    ahead = torch.tensor([[20.0], [70.0]])
    env.state = EnvState(physics, torch.zeros(2, 80), torch.tensor([5, 5]), ahead)
    seen = env.observation()
    assert (seen[0, :82] - seen[1, :82]).abs().max() < 1e-4
    assert seen[:, 82].tolist() == pytest.approx([0.24, 0.24])
    action = 0.5 * torch.randn(1, 80, generator=torch.Generator().manual_seed(2)).repeat(2, 1)
    found = env.step(action, auto_reset=False)
    # The curves of muscles differ by 1 % between the sides, those of two by more; activations are equal.
    assert (found.obs[0, :83] - found.obs[1, :83]).abs().max() < 4e-2
    assert (found.obs[0, :83] - found.obs[1, :83]).abs().mean() < 2e-3
    assert (found.obs[0, :83] - seen[0, :83]).abs().max() > 0.1
    torch.testing.assert_close(found.obs[0, -80:], found.obs[1, -80:], atol=1e-5, rtol=0.0)


def test_gradients_of_a_step() -> None:
    model = build_myosuite_walk(settings(), PhysicsConfig())
    assert model.opt.timestep == pytest.approx(1e-3)
    assert set(model.actuator_dynprm[:, 2]) == {0.2}
    report = check_gradients(Simulation(model, 2, 10, tolerance=1e-9), states=("standing", "policy"))
    assert report.checked >= 2
    assert {r.input for r in report.results} == {"ctrl", "qpos", "qvel", "act"}
    assert report.max_rel_error <= 1e-3


def test_reward_and_observation_have_the_gradient_of_their_own_values() -> None:
    env = make(1)
    rng = np.random.default_rng(3)
    parts = [part[0].numpy().astype(float) for part in env.state.physics]
    parts[0][7:] += 0.05 * rng.normal(size=28)
    parts[1] += 0.5 * rng.normal(size=34)
    parts[2][:] = rng.uniform(0.1, 0.9, size=80)
    action = torch.zeros(1, 80)
    weights = torch.tensor(rng.normal(size=env.obs_size), dtype=torch.float32)

    def value(arrays: list[torch.Tensor]) -> torch.Tensor:
        state = StepState(*arrays)
        obs = env.observe(state, action)
        return (obs * weights).sum() + env.reward_terms(state, action, obs).sum()

    check_slopes(value, parts, rng)


def test_scores_are_without_what_makes_training_easier() -> None:
    rewards = MyoSuiteWalkReward(done=-10.0, height=200.0, footfall=1.0)
    trained = settings(reset="random", smoothing=0.4, cycle=0.5, assist={"epochs": 9}, reward=rewards)
    assert MyoSuiteWalk.reference_settings(trained) == settings(reset="random", smoothing=0.0)
    physics = PhysicsConfig(cone="elliptic", substeps=5)
    model = build_myosuite_walk(settings(smoothing=0.0), MyoSuiteWalk.reference_physics(physics, None))
    assert (model.opt.timestep, int(model.opt.cone), set(model.actuator_dynprm[:, 2])) == (1e-3, 0, {0.0})


def test_the_config_trains_and_its_gait_is_measured(root: Path, tmp_path: Path) -> None:
    small = (f"env.model={walk_model()}", "env.nworld=2", "shac.horizon=2", "trial.epochs=1", "actor.hidden=[8]")
    rest = ("critic.hidden=[8]", "evaluation.nworld=2", "evaluation.steps=2", "evaluation.interval=1")
    trainer = Trainer(load_config(root / "configs" / "myosuite_walk.yaml", [*small, *rest]), tmp_path, "cpu")
    before = torch.cat([p.detach().flatten().clone() for p in trainer.algorithm.actor.parameters()])
    trainer.run_epoch()
    after = torch.cat([p.detach().flatten() for p in trainer.algorithm.actor.parameters()])
    trainer.close()
    assert after.isfinite().all()
    assert not torch.equal(before, after)
    assert gait([str(tmp_path), "--worlds", "1", "--steps", "5", "--device", "cpu"]) == 0
    assert json.loads((tmp_path / "gait.json").read_text())["episodes"] == 1
    with pytest.raises(ConfigError, match="--film: env myosuite_walk has no poses of people; leave it out"):
        gait([str(tmp_path), "--film", str(tmp_path / "stride.gif")])


def test_a_model_that_is_not_myosuites_is_refused_on_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install = "pip install --no-deps myosuite==2.12.2"
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=f"MyoSuite 2.12 is not installed: {install}"):
        find_file(None)
    spec = ModuleSpec("myosuite", None, is_package=True)
    spec.submodule_search_locations = [str(tmp_path)]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: spec)
    monkeypatch.setattr("importlib.metadata.version", lambda name: "3.0.0")
    with pytest.raises(ConfigError, match=f"the task of MyoSuite 2.12, but 3.0.0 is installed: {install}"):
        find_file(None)
    with pytest.raises(ConfigError, match=f"no file gone.xml; {install}"):
        find_file("gone.xml")
    text = Path(walk_model()).read_text()
    for old, new, why in (
        ("<keyframe>", "<keyframe><key/>", "has 5 keyframes, not MyoSuite's 4"),
        ('name="hip_rotation_l"', 'name="hip_turn_l"', "has no hip_rotation_l"),
    ):
        path = tmp_path / "other.xml"
        path.write_text(text.replace(old, new))
        with pytest.raises(ConfigError, match=why):
            build_myosuite_walk(settings().model_copy(update={"model": str(path)}), PhysicsConfig())
