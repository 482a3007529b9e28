"""Shared fixtures. Worlds are few and rollouts short: everything here runs on two CPU cores."""

from pathlib import Path

import pytest

from msk_ray.config import Config, parse_config

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def root() -> Path:
    """Top folder of the repository."""
    return ROOT


@pytest.fixture
def tiny_cartpole() -> Config:
    """A CartPole trial of seconds."""
    return parse_config(
        {
            "env": {"name": "cartpole", "nworld": 8, "episode_length": 40},
            "shac": {"horizon": 8, "critic_iterations": 2, "critic_batches": 2},
            "actor": {"hidden": [16, 16]},
            "critic": {"hidden": [16, 16]},
            "evaluation": {"interval": 2, "nworld": 4, "steps": 20},
            "trial": {"epochs": 6, "checkpoint_interval": 2},
        }
    )
