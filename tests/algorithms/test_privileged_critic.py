"""A critic that sees something other than the policy: what it learns from, its gradient, and what is saved."""

import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

from msk_ray.config import Config, overlay, parse_config
from msk_ray.errors import SimulationError
from msk_ray.experiment.metrics import read_metrics
from msk_ray.training import Trainer
from msk_ray.training.checkpoint import read_checkpoint
from msk_ray.training.policy import load_policy

PPO = {"algorithm": {"name": "ppo"}, "ppo": {"steps": 8}}


@pytest.fixture
def config(tiny_settings: dict[str, Any]) -> Config:
    return parse_config(overlay(tiny_settings, {"env.name": "privileged:Privileged", "critic.count": 2}))


def train(config: Config, folder: Path, epochs: int) -> Trainer:
    trainer = Trainer(config, folder, "cpu")
    for _ in range(epochs):
        trainer.run_epoch()
    trainer.close()
    return trainer


def named(config: Config, name: str) -> Config:
    return parse_config(overlay(config.as_dict(), {"env.name": name}))


def test_a_critic_that_sees_the_same_by_a_method_of_its_own_learns_the_same(
    tiny_cartpole: Config, tmp_path: Path
) -> None:
    """To the bit, with statistics of its own that are those of the policy."""
    plain = train(tiny_cartpole, tmp_path / "plain", 3).algorithm.modules()
    alike = train(named(tiny_cartpole, "privileged:Alike"), tmp_path / "alike", 3).algorithm.modules()
    assert set(alike) - set(plain) == {"critic_normalizer"}
    for name, module in alike.items():
        other = plain["normalizer" if name == "critic_normalizer" else name].state_dict()
        assert all(torch.equal(value, other[key]) for key, value in module.state_dict().items()), name


def test_each_network_has_its_own_inputs_and_statistics(config: Config, tmp_path: Path) -> None:
    algorithm = train(config, tmp_path, 2).algorithm
    assert (algorithm.normalizer.mean.shape, algorithm.critic_normalizer.mean.shape) == ((2,), (5,))
    assert [member[0].in_features for member in algorithm.critic.members] == [5, 5]
    torch.testing.assert_close(algorithm.critic_normalizer.mean[:2], algorithm.normalizer.mean)
    assert algorithm.critic_normalizer.var[2:4].min() > 0.0


def test_the_gradient_of_the_last_value_reaches_the_action_through_what_only_the_critic_sees(
    config: Config, tmp_path: Path
) -> None:
    """Of velocities: within one step they alone depend much on the action. Against differences of the loss."""
    settings = {"shac.horizon": 1, "shac.reward_scale": 1e-6, "shac.critic_batches": 1}
    algorithm = train(parse_config(overlay(config.as_dict(), settings)), tmp_path, 1).algorithm
    update, bias = algorithm._actor_update, algorithm.actor.mean[-1].bias
    inputs = algorithm._draw(1, 1)

    graph = update.roll_out(inputs)
    algorithm.actor_optimizer.zero_grad()
    update.compute_loss(graph).loss.backward()
    graph.calls.add_gradients()
    gradient, values = float(bias.grad), []
    for side in (0.002, -0.002):
        with torch.no_grad():
            bias += side
            values.append(float(update.compute_loss(update.roll_out(inputs)).loss))
            bias -= side
    assert abs(gradient) > 1e-3
    assert gradient == pytest.approx((values[0] - values[1]) / 0.004, rel=1e-2)


@pytest.mark.parametrize("algorithm", ["shac", "ppo"])
def test_a_trial_resumes_exactly_and_its_policy_is_read_like_any_other(
    config: Config, tmp_path: Path, algorithm: str
) -> None:
    settings = config.as_dict()
    if algorithm == "ppo":
        del settings["shac"], settings["critic"]["count"], settings["execution"]["capture"]
        settings["actor"] = {"hidden": [16, 16]}
        settings |= PPO
    trial = parse_config(settings)
    whole = train(trial, tmp_path / "whole", 4)
    train(trial, tmp_path / "cut", 3)
    cut = Trainer(trial, tmp_path / "cut", "cpu")
    cut.restore_latest()
    assert cut.epoch == 2
    for _ in range(2):
        cut.run_epoch()
    cut.close()
    assert cut.algorithm.parameter_hash() == whole.algorithm.parameter_hash()
    saved = load_policy(whole.best_checkpoint)
    assert saved.sizes.obs == 2
    assert saved(torch.zeros(3, 2)).shape == (3, 1)
    assert len(read_metrics(tmp_path / "cut" / "metrics.jsonl")) == 5


def test_a_critic_from_a_trial_with_one_view_goes_on_with_the_policys_statistics(
    tiny_cartpole: Config, tmp_path: Path
) -> None:
    train(tiny_cartpole, tmp_path / "plain", 2)
    start = {"trial.start_from": str(tmp_path / "plain" / "checkpoints" / "epoch_000002.pt")}
    trainer = Trainer(parse_config(overlay(named(tiny_cartpole, "privileged:Alike").as_dict(), start)), tmp_path, "cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        trainer._begin()
    saved = read_checkpoint(tmp_path / "plain" / "checkpoints" / "epoch_000002.pt")["algorithm"]["modules"]
    assert torch.equal(trainer.algorithm.critic_normalizer.mean, saved["normalizer"]["mean"])
    assert trainer.algorithm.critic_normalizer.mean.any()
    trainer.close()


@pytest.mark.parametrize("algorithm", ["shac", "ppo"])
def test_what_is_not_finite_for_the_critic_is_named(
    tiny_settings: dict[str, Any], tmp_path: Path, algorithm: str
) -> None:
    changes = {"env.name": "privileged:Broken"} | (
        {"algorithm.name": "ppo", "ppo.steps": 8} if algorithm == "ppo" else {}
    )
    trainer = Trainer(parse_config(overlay(tiny_settings, changes)), tmp_path, "cpu")
    with pytest.raises(SimulationError, match=r"nonfinite_observation: entry 4 of observe_critic is nan in world \d"):
        trainer.run_epoch()
    trainer.close()
