"""Policies without an environment."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from msk_ray.envs import make_env
from msk_ray.errors import CheckpointError
from msk_ray.training import load_policy
from msk_ray.training.policy import SavedPolicy, Sizes

RECORDED = Path(__file__).parents[1] / "fixtures" / "recorded"


@pytest.fixture(scope="module")
def saved() -> SavedPolicy:
    return load_policy(RECORDED / "train_finished" / "checkpoints" / "best.pt")


def test_it_is_a_function_of_the_observation(saved: SavedPolicy) -> None:
    env = make_env(saved.config.env, saved.config.physics, 3, "cpu", 0, differentiable=False)
    obs = env.observation()
    action = saved(obs)
    assert torch.equal(action, saved.on(env)(obs))
    assert not action.requires_grad
    one = saved(obs[0].double().numpy())
    assert isinstance(one, np.ndarray)
    assert one == pytest.approx(action[0].numpy(), abs=1e-6)


@pytest.mark.parametrize(("name", "sizes"), [("ant", (37, 8)), ("myoleg26", (166, 26)), ("train_finished", (5, 1))])
def test_checkpoints_that_do_not_say_their_sizes_show_them(name: str, sizes: tuple[int, int]) -> None:
    for path in (RECORDED / name / "checkpoints").glob("*.pt"):
        policy = load_policy(path)
        assert policy.sizes == Sizes(*sizes)
        assert policy(torch.zeros(2, sizes[0])).shape == (2, sizes[1])


def test_observations_of_another_size_are_refused(saved: SavedPolicy) -> None:
    with pytest.raises(CheckpointError, match=r"best\.pt takes observations of size 5, not 4"):
        saved(torch.zeros(4))


def test_sizes_that_nobody_knows_are_an_error(saved: SavedPolicy) -> None:
    with pytest.raises(CheckpointError, match=r"its weights do not show them: use `on\(env\)`"):
        dataclasses.replace(saved, sizes=None)(torch.zeros(5))
