"""Exported policies compute what their checkpoints do, and run in C MuJoCo without this package."""

import json
import re
import runpy
import sys
from pathlib import Path

import mujoco
import numpy as np
import onnxruntime
import pytest
import torch
from myosuite_model import walk_model

import msk_ray
from msk_ray.cli import run
from msk_ray.config import PhysicsConfig, load_config, packages
from msk_ray.envs import make_env
from msk_ray.envs.cartpole.config import CartPoleSettings
from msk_ray.envs.cartpole.env import CartPole
from msk_ray.envs.layout import Entry
from msk_ray.errors import ConfigError, ExportError
from msk_ray.evaluate.measure import Bench, Request
from msk_ray.export import network
from msk_ray.export.__main__ import main
from msk_ray.export.compare import largest_difference, observations
from msk_ray.export.description import describe
from msk_ray.export.network import PolicyToControl
from msk_ray.shipped import shipped_folder
from msk_ray.step import StepState

pytestmark = pytest.mark.long

CHECKPOINT = shipped_folder() / "policies" / "cartpole.pt"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """CartPole's trained policy as ONNX; in the same folder as TorchScript, of another name."""
    folder = tmp_path_factory.mktemp("exported")
    assert run(main, ["cartpole", "--onnx", str(folder / "p.onnx"), "--torchscript", str(folder / "q.pt")]) == 0
    return folder / "p.onnx"


@pytest.fixture(scope="module")
def env() -> CartPole:
    return make_env(CartPoleSettings(name="cartpole"), PhysicsConfig(), 4, "cpu", 0, differentiable=False)


def test_both_files_compute_the_actions_of_the_checkpoint(exported: Path) -> None:
    saved = msk_ray.load_policy(CHECKPOINT)
    obs = 3.0 * torch.randn(50, 5, generator=torch.Generator().manual_seed(1))
    session = onnxruntime.InferenceSession(str(exported), providers=["CPUExecutionProvider"])
    scripted = torch.jit.load(str(exported.with_name("q.pt")))
    for action, ctrl in (session.run(None, {"obs": obs.numpy()}), scripted(obs)):
        assert np.abs(np.asarray(action) - saved(obs).numpy()).max() <= 1e-5
        assert np.array_equal(ctrl, action)  # CartPole's control is its action
    assert saved(obs).abs().max() > 0.5


def test_description_and_model_say_what_another_program_needs(exported: Path) -> None:
    about = json.loads(exported.with_suffix(".json").read_text())
    assert [(e["name"], e["unit"]) for e in about["observation"]["entries"]][:2] == [
        ("cart_position", "m"),
        ("cart_velocity", "m/s"),
    ]
    assert about["files"] == {"onnx": "p.onnx", "model": "p.mjb"}
    assert (about["trained"]["env"], about["trained"]["env_settings"]["name"]) == ("cartpole", "cartpole")
    assert about["trained"]["env_settings"]["control_timestep"] == about["control_period_s"]
    assert about["memory"] == []
    assert about["action"]["names"] == about["ctrl"]["names"] == ["force"]
    assert about["ctrl"]["ranges"] == [[-1.0, 1.0]]
    assert about["model"]["start"]["qpos"] == pytest.approx([0.0, np.pi])
    model = mujoco.MjModel.from_binary_path(str(exported.with_suffix(".mjb")))
    assert about["control_period_s"] == pytest.approx(about["physics_steps_per_control"] * model.opt.timestep)
    assert [model.joint(i).name for i in range(model.njnt)] == about["model"]["joints"]


def test_without_a_layout_the_description_says_what_to_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(CartPole, "observation_layout", lambda self: None)
    monkeypatch.setattr(CartPole, "__doc__", None)
    assert run(main, ["cartpole", "--torchscript", str(tmp_path / "p.pt")]) == 0
    assert "to name entries of the observation, write CartPole.observation_layout" in capsys.readouterr().out
    about = json.loads((tmp_path / "p.json").read_text())["observation"]
    assert about == {"size": 5, "entries": None, "description": None}, "not that of the class it inherits from"


def test_in_c_mujoco_it_scores_what_evaluate_says(
    exported: Path, root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    example = root / "docs" / "examples" / "run_cartpole.py"
    assert len(example.read_text().splitlines()) <= 40
    assert "import msk_ray" not in example.read_text()
    monkeypatch.setattr(sys, "argv", [example.name, str(exported), "8", "240"])
    runpy.run_path(str(example), run_name="__main__")
    found = re.search(r"mean return of 8 episodes: (-[\d.]+)", capsys.readouterr().out)
    assert found is not None
    score = Bench("cpu").evaluate(msk_ray.load_policy(CHECKPOINT), Request(worlds=8))["score"]["mean"]
    assert float(found[1]) == pytest.approx(score, rel=0.02)


def test_what_differs_is_refused_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    right = network.to_torchscript

    def wrong(policy: PolicyToControl, obs: torch.Tensor) -> tuple[bytes, network.Runner]:
        payload, runner = right(policy, obs)
        return payload, lambda obs: [part + 2e-5 for part in runner(obs)]

    monkeypatch.setattr(network, "to_torchscript", wrong)
    assert run(main, ["cartpole", "--torchscript", str(tmp_path / "p.pt")]) == ExportError.exit_code
    (error,) = capsys.readouterr().err.splitlines()[-1:]
    assert "not written: its action differs from the checkpoint's by 2.0e-05" in error
    assert not list(tmp_path.iterdir())


def test_numbers_that_are_not_finite_are_refused(env: CartPole) -> None:
    policy = PolicyToControl(torch.nn.Linear(5, 1), env)
    obs = torch.ones(10, 5)
    with pytest.raises(ExportError, match="its ctrl differs from the checkpoint's by nan"):
        largest_difference(policy, lambda obs: [policy(obs)[0], policy(obs)[1] * torch.nan], obs)


class Braked(CartPole):
    """A cart whose control is not the action alone."""

    def control(self, action: torch.Tensor) -> torch.Tensor:
        return action - 0.1 * self.state.physics.qvel[: len(action), :1]


class Smoothed(CartPole):
    """A cart whose motor takes a while."""

    def control(self, action: torch.Tensor) -> torch.Tensor:
        return 0.7 * action + 0.3 * self.state.action


class Buffered(CartPole):
    """A cart with a constant for each of its worlds."""

    def prepare(self) -> None:
        super().prepare()
        self.gain = torch.full((self.nworld, 1), 0.5)

    def control(self, action: torch.Tensor) -> torch.Tensor:
        return self.gain * action


class Mislaid(CartPole):
    def observation_layout(self) -> list[Entry]:
        return [Entry("cart_position", "m")]


def test_controls_that_depend_on_the_state_are_left_out(env: CartPole) -> None:
    braked = Braked(env.config, PhysicsConfig(), 4, "cpu", 0, None)
    policy = PolicyToControl(torch.nn.Linear(5, 1), braked)
    assert policy.outputs == ["action"]
    about = describe(msk_ray.load_policy(CHECKPOINT), policy, braked, "own", {})
    assert about["ctrl"] is None


def test_controls_that_depend_on_the_action_before_take_it_as_an_input(env: CartPole) -> None:
    smoothed = Smoothed(env.config, PhysicsConfig(), 4, "cpu", 0, None)
    policy = PolicyToControl(torch.nn.Sequential(torch.nn.Linear(5, 1), torch.nn.Tanh()), smoothed).eval()
    inputs = policy.examples(observations(smoothed, 0), 0)
    for write in (network.to_onnx, network.to_torchscript):
        run_exported = write(policy, *inputs)[1]
        assert largest_difference(policy, run_exported, *inputs) <= 1e-5
        # Fed back step by step, they are the controls of the environment's own steps.
        smoothed.state = smoothed.reset_state()
        previous = torch.zeros(4, 1)
        for _ in range(3):
            action, ctrl = run_exported(smoothed.observation(), previous)
            assert torch.equal(ctrl, 0.7 * action + 0.3 * previous)
            assert torch.allclose(ctrl, smoothed.control(action))
            smoothed.step(action, auto_reset=False)
            previous = action
    about = describe(msk_ray.load_policy(CHECKPOINT), policy, smoothed, "own", {})
    (previous,) = about["memory"]
    assert (previous["input"], previous["output"], previous["start"]) == ("previous_action", "action", [0.0])
    assert about["ctrl"]["size"] == 1


def test_a_control_for_so_many_worlds_alone_is_refused_in_one_line(env: CartPole) -> None:
    buffered = Buffered(env.config, PhysicsConfig(), 4, "cpu", 0, None)
    wanted = r"Buffered\.control fails for 1 rows of actions \(it returns shape \(4, 1\)\): .*`self.memory`"
    with pytest.raises(ExportError, match=wanted):
        PolicyToControl(torch.nn.Linear(5, 1), buffered)


def test_a_layout_of_another_length_is_refused(env: CartPole) -> None:
    mislaid = Mislaid(env.config, PhysicsConfig(), 4, "cpu", 0, None)
    policy = PolicyToControl(torch.nn.Linear(5, 1), mislaid)
    with pytest.raises(ConfigError, match="observation_layout of Mislaid has 1 entries for observations of size 5"):
        describe(msk_ray.load_policy(CHECKPOINT), policy, mislaid, "own", {})


def test_without_onnx_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(packages, "find_spec", lambda name: None if name == "onnxruntime" else object())
    assert run(main, ["cartpole", "--onnx", str(tmp_path / "p.onnx")]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert "--onnx needs the package onnxruntime, which is not installed: pip install 'msk-ray[export]'" in error


@pytest.mark.parametrize("name", ["cartpole", "ant", "cheetah", "myoleg26", "myosuite_walk"])
def test_layouts_name_the_entries_of_observations(name: str) -> None:
    config = load_config(name, [f"env.model={walk_model()}"] if name == "myosuite_walk" else [])
    env = make_env(config.env, config.physics, 1, "cpu", 0, differentiable=False)
    names = [entry.name for entry in env.observation_layout() or ()]
    assert len(names) == len(set(names)) == env.obs_size
    actions = env.action_names()
    assert actions is not None
    assert len(actions) == env.action_size
    # A joint moved by 0.01 shows up in the entries that carry its name, and a velocity of 1 with its scale.
    joint = {"ant": "ankle_3", "myoleg26": "knee_angle_r"}.get(name)
    if joint:
        state = env.state.physics
        moved = StepState(*(part.clone() for part in state))
        moved.qpos[:, env.model.joint(joint).qposadr[0]] += 0.01
        moved.qvel[:, env.model.joint(joint).dofadr[0]] += 1.0
        action = torch.zeros(1, env.action_size)
        change = (env.observe(moved, action) - env.observe(state, action))[0]
        assert change[names.index(f"{joint}_angle")].item() == pytest.approx(0.01, rel=1e-3)
        assert change[names.index(f"{joint}_rate")].item() == pytest.approx(0.1, rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cartpole"], "nothing to write"),
        (["cartpole", "--onnx", "p.pt"], "write a name that ends in .onnx"),
        (["cartpole", "--torchscript", str(CHECKPOINT)], "this is the checkpoint itself"),
        (["cartpool", "--onnx", "p.onnx"], "policies/ ant, ant_fast, ant_fast_friction, ant_hard, cartpole"),
        (["cartpole", "--onnx", "p.onnx", "--physics", "moon"], "write one of reference, own"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(main, arguments) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert message in error
    assert not list(tmp_path.iterdir())
