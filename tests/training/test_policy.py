"""Policies without an environment."""

from pathlib import Path

import numpy as np
import pytest
import torch

from msk_ray.envs import make_env
from msk_ray.errors import CheckpointError
from msk_ray.training import load_policy
from msk_ray.training.policy import SavedPolicy

RECORDED = Path(__file__).parents[1] / "fixtures" / "version_0_2" / "sweep" / "trials" / "e64db494"


@pytest.fixture(scope="module")
def saved() -> SavedPolicy:
    return load_policy(RECORDED / "checkpoints" / "best.pt")


def test_it_is_a_function_of_the_observation(saved: SavedPolicy) -> None:
    env = make_env(saved.config.env, saved.config.physics, 3, "cpu", 0, differentiable=False)
    obs = env.observation()
    action = saved(obs)
    assert torch.equal(action, saved.on(env)(obs))
    assert not action.requires_grad
    one = saved(obs[0].double().numpy())
    assert isinstance(one, np.ndarray)
    assert one == pytest.approx(action[0].numpy(), abs=1e-6)


def test_observations_of_another_size_are_refused(saved: SavedPolicy) -> None:
    with pytest.raises(CheckpointError, match=r"best\.pt takes observations of size 5, not 4"):
        saved(torch.zeros(4))
