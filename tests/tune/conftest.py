"""A small space over CartPole, and how to vary it."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from msk_ray.config import dump_yaml
from msk_ray.tune import runner
from msk_ray.tune.space import Space, parse_space

MakeSpace = Callable[..., Space]

BASE = {
    "env": {"name": "cartpole", "nworld": 8},
    "shac": {"horizon": 8},
    "evaluation": {"interval": 2},
    "trial": {"epochs": 20, "checkpoint_interval": 2},
}


@pytest.fixture
def space_data(tmp_path: Path) -> dict[str, Any]:
    """A space of two learning rates, whose base lies in `tmp_path`."""
    (tmp_path / "base.yaml").write_text(dump_yaml(BASE))
    return {
        "question": "Which rate?",
        "base": "base.yaml",
        "parameters": {"shac.actor_lr": {"grid": [0.01, 0.001]}},
    }


@pytest.fixture
def make_space(tmp_path: Path, space_data: dict[str, Any]) -> MakeSpace:
    """Makes a space with some fields replaced."""

    def make(**changes: Any) -> Space:
        return parse_space(space_data | changes, tmp_path / "small.yaml")

    return make


@pytest.fixture
def plans(monkeypatch: pytest.MonkeyPatch) -> list[runner.Plan]:
    """What a driver would run: it gets as far as its plan, and ends as if it had been stopped there."""
    made: list[runner.Plan] = []
    monkeypatch.setattr(runner, "ray_session", lambda *args: contextlib.nullcontext())
    monkeypatch.setattr(runner, "run_trials", lambda plan: bool(made.append(plan)))
    return made
