"""The page docs/robots/follow_commands.md, from its first command to the last, in tiny sizes."""

import os
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch
from needs import need_what_caused
from test_commands import commands_of

from msk_ray import __main__ as commands
from msk_ray.config import load_config
from msk_ray.envs import make_env
from msk_ray.play.screen import Screen
from msk_ray.step import StepState

pytestmark = pytest.mark.long

TINY = (
    *("env.nworld=2", "shac.critic_iterations=1", "shac.critic_batches=1", "actor.hidden=[8]", "critic.hidden=[8]"),
    *("trial.epochs=1", "evaluation.interval=1", "evaluation.nworld=2", "evaluation.steps=3", "execution.loggers=[]"),
)
SMALLER = {
    "gradcheck": ["--worlds", "2", "--states", "random"],
    "play": ["--episodes", "1", "--steps", "2", "--device", "cpu"],
    "train": ["--device", "cpu", *(word for setting in TINY for word in ("--set", setting))],
    "evaluate": ["--worlds", "2", "--steps", "3", "--device", "cpu"],
    "visualize": ["--steps", "3", "--device", "cpu"],
    "export": [],
}


class Blind(Screen):
    """Nobody looks."""

    def is_open(self) -> bool:
        return True

    def show(self, state: Any, control: Any) -> None:
        self._take(state, control)


@contextmanager
def blind(args: Any, model: mujoco.MjModel, groups: Any) -> Iterator[Screen]:
    yield Blind(model)


@pytest.fixture
def page(root: Path) -> Path:
    return root / "docs" / "robots" / "follow_commands.md"


@pytest.fixture
def folder(page: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the files of the page."""
    text = page.read_text()
    files = re.findall(r"^## .*?`(\w+\.(?:py|yaml))`$.*?```\w+\n(.*?)```", text, re.DOTALL | re.MULTILINE)
    assert [name for name, _ in files] == ["my_robot.py", "my_robot.yaml", "follow.py"]
    for name, content in files:
        (tmp_path / name).write_text(content)
    copy = re.search(r"^    (cp .*)$", text, re.MULTILINE)
    assert copy is not None
    paths = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(root)}
    subprocess.run(["bash", "-c", copy[1]], cwd=tmp_path, env=os.environ | paths, check=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("my_robot", None)


def test_commands_and_programs_of_the_page_run(
    page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("msk_ray.play.__main__._screen", blind)
    done = []
    for name, words in commands_of(page):
        if "--video" in words:  # pictures have tests of their own
            words = [*words[: words.index("--video")], "--no-render"]
        assert commands.main([name, *words, *SMALLER[name]]) == 0, (name, capsys.readouterr().err)
        done.append(name)
    assert done == ["gradcheck", "play", "train", "evaluate", "play", "visualize", "visualize", "export"]
    said = capsys.readouterr().out
    assert re.search(r"episode 1: score .*, 0\.0 s, time", said)
    kept = "    state = data.qpos.copy(), data.qvel.copy()\n"
    program = Path("follow.py").read_text()
    Path("follow.py").write_text(program.replace("    mujoco.mj_step(", f"{kept}    mujoco.mj_step("))
    try:
        follow = runpy.run_path("follow.py")
    except ImportError as error:
        need_what_caused(error)
        raise
    assert list(follow["carried"]) == ["memory_history"], "the history is inside"
    assert follow["data"].qpos[2] > 0.2, "it stands, as its policy hardly moves"
    assert capsys.readouterr().out.startswith("after 9.0 s at x = ")
    _compare_observation(follow)


def test_the_shipped_go1_ends_where_the_page_says(page: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.main(["export", "go1_velocity", "--onnx", "my_robot.onnx"]) == 0
    program = Path("follow.py").read_text()
    Path("follow.py").write_text(program.replace("((gyro,", '((data.sensor("imu_lin_vel").data, gyro,'))
    runpy.run_path("follow.py")
    place = re.compile(r"at x\s=\s(-?\d\S*)\sm,\sy\s=\s(-?\d\S*)\sm,\sz\s=\s(-?\d\S*)\sm")
    said, expected = (place.search(text) for text in (capsys.readouterr().out, page.read_text()))
    assert said is not None
    assert expected is not None
    assert [float(x) for x in said.groups()] == pytest.approx([float(x) for x in expected.groups()], abs=0.2)


def test_the_history_of_the_page_holds_what_the_policy_was_given(folder: Path) -> None:
    config = load_config("my_robot.yaml")
    assert config.physics.randomize is not None
    env = make_env(config.env, config.physics, 4, "cpu", 0, differentiable=False, randomize=True)
    size, before = 6 + 3 * env.action_size, env.observation()
    for _ in range(5):
        obs = env.step(torch.zeros(4, env.action_size)).obs
        assert torch.equal(obs[:, size : 4 * size], before[:, : 3 * size])
        before = obs
    assert not torch.equal(before, env.observe(env.state.physics, env.state.action))


def _compare_observation(follow: dict[str, Any]) -> None:
    """The last observation of the program is that of the environment in the same state."""
    config = load_config("my_robot.yaml")
    env = make_env(config.env, config.physics, 1, "cpu", 0, differentiable=False)
    qpos, qvel = (torch.as_tensor(part, dtype=torch.float32)[None] for part in follow["state"])
    frame = torch.as_tensor(follow["obs"], dtype=torch.float32)[None, :-3]
    action = frame[:, -env.action_size :] / config.env.action_range
    assert qvel.abs().max() > 1e-4
    assert torch.allclose(env.measured(StepState(qpos, qvel, qvel[:, :0]), action), frame, atol=1e-4)
