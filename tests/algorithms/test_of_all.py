"""What all algorithms share: the counting of episodes, and diagnostics of worlds spread over several processes."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn

from msk_ray.algorithms import algorithm_class
from msk_ray.algorithms.base import Algorithm, EpochResult
from msk_ray.config import Config, PhysicsConfig
from msk_ray.envs import make_env
from msk_ray.errors import ConfigError
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.metrics import of_all_processes


class Silent(Algorithm):
    """Does not count episodes."""

    @classmethod
    def policy_network(cls, config: Config, obs_size: int, action_size: int) -> nn.Module:
        return nn.Linear(obs_size, action_size)

    def update(self, epoch: int) -> EpochResult:
        return EpochResult(8, {})


class Forgetful(Silent):
    """Says that it does."""

    counts_episodes = True


def test_a_setting_that_reads_episode_lengths_is_refused_before_the_first_step(tiny_cartpole: Config) -> None:
    settings = MyoLeg26Settings.model_validate({"name": "myoleg26", "assist": {"epochs": 2, "steady": 4.0}})
    legs = make_env(settings, PhysicsConfig(), 1, "cpu", 0, differentiable=False)
    with pytest.raises(ConfigError, match=r"env\.assist\.steady needs .* write env\.assist\.steady: null, or return"):
        Silent(tiny_cartpole, legs)
    Forgetful(tiny_cartpole, legs)
    for name in ("shac", "ppo"):
        config = tiny_cartpole.model_copy(update={"algorithm": SimpleNamespace(name=name)})
        assert algorithm_class(config).counts_episodes


def test_an_algorithm_keeps_its_promise_to_count(tiny_cartpole: Config) -> None:
    env: Any = SimpleNamespace(
        obs_size=3,
        action_size=1,
        device=torch.device("cpu"),
        reads_episode_lengths=None,
        enter_epoch=lambda epoch: None,
        end_epoch=lambda length: {"length": length},
    )
    assert Silent(tiny_cartpole, env).run_epoch(0).metrics == {"length": None}
    with pytest.raises(ConfigError, match="return EpochResult"):
        Forgetful(tiny_cartpole, env).run_epoch(0)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("physics/contacts_share", 0.75),
        ("physics/solver_residual_max", 0.75),
        ("physics/fd_solver_limit_share", 0.75),
        ("randomize/gravity_min", 0.25),
        ("randomize/gravity_max", 0.75),
        ("physics/solver_limit_share", 0.5),
        ("grad/approximated_share", 0.5),
    ],
)
def test_shares_of_worlds_are_averaged_and_extremes_stay_extremes(name: str, expected: float) -> None:
    assert of_all_processes(name, [0.25, 0.75]) == expected
    assert math.isnan(of_all_processes(name, [0.25, math.nan]))
