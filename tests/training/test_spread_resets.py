"""Training that begins with episodes of spread ages: worlds that do not fall reset at different times."""

from typing import Any

import pytest
import torch
from torch import Tensor

from msk_ray.config import Config, overlay, parse_config
from msk_ray.envs import Env
from msk_ray.group import Group
from msk_ray.training.evaluation import Evaluator
from msk_ray.training.learner import make_algorithm


class _Half(Group):
    """One of two processes, as far as `spread_ages` asks."""

    size = 2

    def __init__(self, rank: int) -> None:
        self.rank = rank

    def own(self, whole: Tensor, dim: int = 0) -> Tensor:
        return whole.chunk(2, dim)[self.rank]


def _config(settings: dict[str, Any], **env: Any) -> Config:
    return parse_config(overlay(settings, {f"env.{key}": value for key, value in env.items()}))


def _env(settings: dict[str, Any], **env: Any) -> Env[Any]:
    return make_algorithm(_config(settings, **env), "cpu").env


def _resets(env: Env[Any], steps: int) -> list[int]:
    """How many worlds each env step resets; none can fall."""
    with torch.no_grad():
        return [int(env.step(torch.zeros(env.nworld, env.action_size)).truncated.sum()) for _ in range(steps)]


def test_ages_are_multiples_of_the_golden_ratio(tiny_settings: dict[str, Any]) -> None:
    env = _env(tiny_settings, nworld=5, episode_length=1000, spread_resets=True)
    # 0.618034 k modulo 1: 0, 0.618034, 0.236068, 0.854102, 0.472136
    assert env.state.age.tolist() == [0, 618, 236, 854, 472]


@pytest.mark.parametrize(("spread", "most"), [(False, 8), (True, 2)])
def test_worlds_reset_at_different_times(tiny_settings: dict[str, Any], spread: bool, most: int) -> None:
    counts = _resets(_env(tiny_settings, nworld=8, episode_length=10, spread_resets=spread), 20)
    assert max(counts) == most
    assert sum(counts[:10]) == sum(counts[10:]) == 8, "each world resets once per episode length"
    assert counts[:10] == counts[10:]


def test_processes_share_the_ages(tiny_settings: dict[str, Any]) -> None:
    alone = _env(tiny_settings, nworld=8, episode_length=40, spread_resets=True)
    ages = []
    for rank in range(2):
        env = _env(tiny_settings, nworld=4, episode_length=40)
        env.group = _Half(rank)
        env.spread_ages()
        ages += env.state.age.tolist()
    assert ages == alone.state.age.tolist()


def test_an_evaluation_begins_with_new_episodes(tiny_settings: dict[str, Any]) -> None:
    evaluator = Evaluator(_config(tiny_settings, spread_resets=True), "cpu")
    episodes = evaluator.episodes(lambda obs: torch.zeros(len(obs), 1))
    assert episodes.length.tolist() == [20] * len(episodes.length)
