"""The page docs/runner/commands.md: its environment is right as it stands there."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from msk_ray.config import load_config
from msk_ray.envs import make_env
from msk_ray.export.network import PolicyToControl


@pytest.fixture
def folder(tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the files of the page, and those of the page it builds on."""
    before = {name: sys.modules.pop(name, None) for name in ("hopper", "tracker", "faster")}
    for page, name in (
        ("own_robot", "hopper.xml"),
        ("own_robot", "hopper.py"),
        ("own_robot", "hopper.yaml"),
        ("commands", "tracker.py"),
        ("commands", "faster.py"),
    ):
        text = (root / "docs" / "runner" / f"{page}.md").read_text()
        found = re.search(rf"`{name}`:?\n\n```\w+\n(.*?)\n```", text, re.DOTALL)
        assert found is not None, name
        (tmp_path / name).write_text(found[1])
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name, module in before.items():
        sys.modules.pop(name, None)
        if module is not None:
            sys.modules[name] = module


def test_the_environment_of_the_page_follows_commands_remembers_and_carries_its_memory(folder: Path) -> None:
    settings = ["env.name=tracker:Tracker", "env.nworld=2", "env.commands.speed.forward=[2.0, 2.0]"]
    config = load_config(folder / "hopper.yaml", settings)
    env = make_env(config.env, config.physics, 2, "cpu", 0)
    assert env.observation()[:, -4:].tolist() == [[2.0, 0.0, 0.0, 0.0]] * 2
    action = torch.full((2, 3), 0.5, requires_grad=True)
    env.step(action)
    reward = env.step(torch.zeros(2, 3)).reward.sum()
    (gradient,) = torch.autograd.grad(reward, action)
    assert bool(gradient.any(-1).all())
    env.state = env.state.detach()
    policy = PolicyToControl(torch.nn.Linear(env.obs_size, 3), env)
    assert policy.inputs == ["obs", "memory_motor"]
    assert policy.gives_control
    assert not policy.remarks


def test_its_curriculum_changes_commands_that_are_drawn_already(folder: Path) -> None:
    config = load_config(folder / "hopper.yaml", ["env.name=faster:Faster"])
    env = make_env(config.env, config.physics, 64, "cpu", 0)
    before = env.command("speed")
    env.enter_epoch(100)
    assert env.command_ranges["speed"].tolist() == [[-0.5], [2.0]]
    assert torch.allclose(env.command("speed"), -0.5 + (before + 0.5) * 2.5 / 1.5)
    assert env.begin_epoch_in_place
