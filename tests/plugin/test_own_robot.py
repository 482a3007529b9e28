"""The page docs/runner/own_robot.md: its files are right as they stand there."""

import re
import sys
from pathlib import Path

import pytest
import torch

from msk_ray.config import load_config
from msk_ray.envs import make_env
from msk_ray.sweep.space import load_space
from msk_ray.sweep.trials import resolve_trials

pytestmark = pytest.mark.long


@pytest.fixture
def folder(tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files of the page."""
    page = (root / "docs" / "runner" / "own_robot.md").read_text()
    found = re.findall(r"`(\w+\.(?:xml|py|yaml))`:?\n\n```\w+\n(.*?)\n```", page, re.DOTALL)
    assert [name for name, _ in found] == ["hopper.xml", "hopper.py", "hopper.yaml", "hopper_lr.yaml"]
    for name, text in found:
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    other = sys.modules.pop("hopper", None)  # the one of this folder, which another test has imported
    yield tmp_path
    sys.modules.pop("hopper", None)
    if other is not None:
        sys.modules["hopper"] = other


def test_the_files_of_the_page_make_an_environment_with_gradients_and_a_sweep(folder: Path) -> None:
    config = load_config(folder / "hopper.yaml", ["env.nworld=2"])
    env = make_env(config.env, config.physics, 2, "cpu", 0)
    action = torch.zeros(2, env.action_size, requires_grad=True)
    transition = env.step(action)
    assert transition.terms.shape == (2, 3)
    transition.reward.sum().backward()
    assert action.grad is not None
    assert torch.isfinite(action.grad).all()
    assert action.grad.abs().sum() > 0
    trials = resolve_trials(load_space(folder / "hopper_lr.yaml"))
    assert [trial.config.env.name for trial in trials] == ["hopper:Hopper"] * 4


def test_what_the_page_says_can_be_measured_can_be(folder: Path, root: Path) -> None:
    from msk_ray.simulation.kinematics import Frames

    page = (root / "docs" / "runner" / "own_robot.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    named = {name for row in rows for name in re.findall(r"`\.(\w+)\(", row)}
    assert named == {name for name in vars(Frames) if not name.startswith("_")}
