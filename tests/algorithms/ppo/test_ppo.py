"""PPO: trains, resumes exactly, names its failures, and its policies are read like any other."""

import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from msk_ray import train as train_command
from msk_ray.algorithms import algorithm_class
from msk_ray.algorithms.ppo import Ppo
from msk_ray.cli import run
from msk_ray.config import Config, dump_yaml, overlay, parse_config
from msk_ray.envs import make_env
from msk_ray.errors import CheckpointError, ConfigError, Failure, SimulationError
from msk_ray.evaluate import __main__ as evaluate
from msk_ray.experiment.metrics import read_metrics
from msk_ray.metrics import SCORE
from msk_ray.training import Trainer, precompile
from msk_ray.training.checkpoint import epoch_checkpoints, read_checkpoint
from msk_ray.training.policy import load_policy
from msk_ray.training.threads import use_threads

pytestmark = pytest.mark.long


def without_clocks(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    timed = ("seconds", "env_steps_per_s")
    return [{k: v for k, v in row.items() if k not in timed and not k.startswith("time/")} for row in rows]


@pytest.fixture
def config(tiny_settings: dict[str, Any]) -> Config:
    """A CartPole trial of seconds, by PPO."""
    return parse_config(tiny_settings | {"algorithm": {"name": "ppo"}, "ppo": {"steps": 8}})


def make(config: Config) -> Ppo:
    use_threads(config)
    env = make_env(config.env, config.physics, config.env.nworld, "cpu", config.trial.seed, differentiable=False)
    return Ppo(config, env)


def train(config: Config, folder: Path, epochs: int | None = None) -> list[dict[str, Any]]:
    trainer = Trainer(config, folder, "cpu")
    if epochs is None:
        trainer.restore_latest()
    while not trainer.finished and trainer.epoch != epochs:
        trainer.run_epoch()
    trainer.close()
    return read_metrics(folder / "metrics.jsonl")


def test_a_trial_leaves_its_record_and_prints_nothing(
    config: Config, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer = Trainer(config, tmp_path, "cpu")
    assert trainer.env.sim.backward is None, "nothing to differentiate with is built"
    capsys.readouterr()
    rows = [trainer.run_epoch() for _ in range(6)]
    trainer.close()
    assert capsys.readouterr() == ("", "")
    assert [row["env_steps"] for row in rows] == [64 * (i + 1) for i in range(6)]
    scores = [row[SCORE] for row in read_metrics(tmp_path / "metrics.jsonl") if SCORE in row]
    assert len(set(scores)) == 4, "the policy has changed"
    assert all(math.isfinite(value) for row in rows for value in row.values())
    saved = load_policy(epoch_checkpoints(tmp_path / "checkpoints")[0])
    assert saved.config == config
    env = make_env(config.env, config.physics, 8, "cpu", 1, differentiable=False)
    obs = env.observation()
    assert torch.equal(saved.on(env)(obs), trainer.algorithm.policy(obs))
    assert saved.on(env)(1e4 * obs).abs().max() == 1.0


def test_resuming_gives_the_metrics_of_an_uninterrupted_run(config: Config, tmp_path: Path) -> None:
    whole = train(config, tmp_path / "whole")
    train(config, tmp_path / "cut", epochs=5)  # the newest checkpoint is of epoch 4
    torch.rand(7)  # another process draws other numbers before it resumes
    assert without_clocks(train(config, tmp_path / "cut")) == without_clocks(whole)


def test_it_learns(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the reward is the distance of the action from 0.5, its policy goes there."""
    ppo = make(parse_config(overlay(config.as_dict(), {"env.nworld": 32, "ppo.steps": 16})))

    def distance(state: Any, action: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return -(action - 0.5).square().expand(-1, len(ppo.env.reward_names))

    monkeypatch.setattr(ppo.env, "reward_terms", distance)

    def wrong() -> float:
        return float((ppo.policy(ppo.env.observation()) - 0.5).abs().mean())

    before = wrong()
    for epoch in range(30):
        ppo.update(epoch)
    assert wrong() < 0.5 * before


def test_a_weight_that_is_not_finite_ends_the_trial_by_name(config: Config) -> None:
    ppo = make(config)
    next(ppo.network.parameters()).data.fill_(math.nan)
    with pytest.raises(SimulationError, match=r"nonfinite_update: .* lower ppo\.lr") as caught:
        ppo.update(0)
    assert caught.value.failure is Failure.NONFINITE


def test_a_reward_that_is_not_finite_ends_the_trial_by_name(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    ppo = make(config)
    terms = ppo.env.reward_terms
    monkeypatch.setattr(ppo.env, "reward_terms", lambda *args: terms(*args) / 0.0)
    with pytest.raises(SimulationError, match=r"nonfinite_reward: term 'pole_angle' of reward_terms is -inf in"):
        ppo.update(0)


def test_another_algorithms_checkpoint_is_no_start(config: Config, tiny_cartpole: Config, tmp_path: Path) -> None:
    train(tiny_cartpole, tmp_path / "shac", epochs=2)
    settings = config.as_dict()
    settings["trial"]["start_from"] = str(tmp_path / "shac" / "checkpoints" / "best.pt")
    trainer = Trainer(parse_config(settings), tmp_path / "ppo", "cpu")
    with pytest.raises(CheckpointError, match="give a checkpoint of the same env, algorithm and networks"):
        trainer.run_epoch()
    trainer.close()


def test_a_trial_starts_from_another_ones_networks(config: Config, tmp_path: Path) -> None:
    rows = train(config, tmp_path / "first")
    settings = config.as_dict()
    settings["trial"]["start_from"] = str(epoch_checkpoints(tmp_path / "first" / "checkpoints")[0])
    second = train(parse_config(settings), tmp_path / "second", epochs=1)
    assert second[0][SCORE] == pytest.approx(rows[-1][SCORE])


def test_without_the_extra_one_line_names_it(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("msk_ray.config.packages.find_spec", lambda module: None)
    with pytest.raises(
        ConfigError, match=r"ppo needs the package rsl_rl, .* not installed: pip install 'msk-ray\[ppo\]'"
    ):
        algorithm_class(config)
    (tmp_path / "ppo.yaml").write_text(dump_yaml(config.as_dict()))
    command = ["--config", str(tmp_path / "ppo.yaml"), "--logdir", str(tmp_path / "run"), "--device", "cpu"]
    assert run(train_command.main, command) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "run" / "metrics.jsonl").exists()


def test_the_commands_take_it(config: Config, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "ppo.yaml").write_text(dump_yaml(config.as_dict()))
    command = ["--config", str(tmp_path / "ppo.yaml"), "--logdir", str(tmp_path / "run"), "--device", "cpu"]
    assert run(train_command.main, command) == 0
    assert run(evaluate.main, [str(tmp_path / "run"), "--device", "cpu"]) == 0
    capsys.readouterr()
    entry = json.loads((tmp_path / "run" / "eval.json").read_text())
    best = max(row[SCORE] for row in read_metrics(tmp_path / "run" / "metrics.jsonl")[1:] if SCORE in row)
    assert f"{best:.3f}"[:6] in json.dumps(entry)


def test_kernels_are_compiled_by_a_short_epoch(config: Config, tmp_path: Path) -> None:
    precompile(config, "cpu", tmp_path)
    assert read_checkpoint(tmp_path / "checkpoints" / "epoch_000001.pt")["env_steps"] == 4


def test_shac_needs_no_rsl_rl(tiny_cartpole: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rsl_rl", None)
    assert algorithm_class(tiny_cartpole).__name__ == "Shac"
