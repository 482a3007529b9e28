"""Tasks in a viewer: on a virtual display, and as a page for this machine."""

import os
import re
import shutil
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from needs import need_program
from torch import Tensor

from msk_ray.__main__ import main
from msk_ray.config import load_config
from msk_ray.envs import Env, make_env
from msk_ray.errors import ConfigError, DeviceError
from msk_ray.experiment.manifest import Experiment
from msk_ray.play.agents import random_policy, zero_policy
from msk_ray.play.live import play_episodes
from msk_ray.play.screen import Screen
from msk_ray.step import StepState


@pytest.fixture
def env() -> Env:
    config = load_config("cartpole")
    return make_env(config.env, config.physics, 1, "cpu", 0, differentiable=False)


class Screenshots(Screen):
    """Keeps positions; is closed after some of them."""

    def __init__(self, model: mujoco.MjModel, count: int) -> None:
        super().__init__(model)
        self.count = count
        self.shown: list[np.ndarray] = []

    def is_open(self) -> bool:
        return len(self.shown) < self.count

    def show(self, state: StepState, control: Tensor) -> None:
        self._take(state, control)
        self.shown.append(self.data.qpos.copy())


def test_episodes_follow_each_other_until_the_screen_is_closed(env: Env) -> None:
    screen = Screenshots(env.model, 7)
    played = list(play_episodes(env, zero_policy(env), 3, 5, screen, 1000.0))
    assert len(screen.shown) == 7, "two episodes and a part of the third"
    assert [round(episode.seconds * 60) for episode in played] == [3, 3]
    assert [episode.ending for episode in played] == ["time", "time"]
    assert all(episode.score < 0.0 for episode in played)
    again = Screenshots(env.model, 3)
    list(play_episodes(env, zero_policy(env), 3, 5, again, 1000.0))
    assert np.array_equal(again.shown, screen.shown[:3]), "the seed says where they begin"


def test_random_actions_repeat_and_leave_starts_as_they_are(env: Env) -> None:
    def actions() -> Tensor:
        policy = random_policy(env, 3)
        return torch.stack([policy(env.observation()) for _ in range(200)])

    before = env.generator.get_state()
    drawn = actions()
    assert torch.equal(actions(), drawn)
    assert drawn.shape == (200, 1, 1)
    assert drawn.min() < -0.9
    assert drawn.max() > 0.9
    assert torch.equal(env.generator.get_state(), before)
    assert not zero_policy(env)(env.observation()).any()


def test_a_screen_draws_a_copy_of_the_model(env: Env) -> None:
    """Simulations refuse models that change."""
    screen = Screenshots(env.model, 1)
    assert screen.model is not env.model
    assert screen.model.vis.rgba.contactforce.tolist() != env.model.vis.rgba.contactforce.tolist()


@pytest.mark.long
def test_the_page_is_for_this_machine_alone_and_shows_the_state(env: Env, capsys: pytest.CaptureFixture[str]) -> None:
    from msk_ray.play.browser import browser

    with browser(env.model, (0, 1, 2), 0) as screen:
        port = int(re.fullmatch(r"http://127\.0\.0\.1:(\d+)/; Ctrl-C ends it\n", capsys.readouterr().out)[1])
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as page:
            assert b"<html" in page.read()
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.2", port))
        with pytest.raises(ConfigError, match=f"port {port}: it is in use"), browser(env.model, (0,), port):
            pass
        state = env.state.physics
        screen.show(state._replace(qpos=state.qpos + 0.5), torch.zeros(1, 1))
        (cart, *_) = (group for group in screen._scene._mesh_groups if env.model.body("cart").id in group.body_ids)
        assert screen.data.qpos[0] == pytest.approx(float(state.qpos[0, 0]) + 0.5)
        assert np.allclose(cart.handle.batched_positions, 0.0), "the camera follows the first body that moves"
    assert screen.is_open()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name a task, as msk-ray list does, or a policy: --agent runs/demo"),
        (["cartpole"], "there is no display: add --browser (pip install 'msk-ray[browser]')"),
        (["cartpole", "--port", "1"], "--port: only --browser reads it"),
        (["cartpole", "--browser"], "--browser needs mjviser: pip install 'msk-ray[browser]'"),
        (["cartpole", "--speed", "nan"], "--speed nan: write a number above 0"),
        (["cartpole", "--seed", f"{10**20}"], f"seeds {10**20}: write whole numbers"),
    ],
)
def test_what_cannot_work_is_said_in_one_line(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("msk_ray.play.__main__.find_spec", lambda name: None)
    assert main(["play", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_a_display_that_does_not_open_is_no_display(env: Env, monkeypatch: pytest.MonkeyPatch) -> None:
    from msk_ray.play.desktop import desktop

    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":98765")
    with pytest.raises(DeviceError, match="there is no display: add --browser"), desktop(env.model, (0,)):
        pass


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cartpol"], "unknown name 'cartpol'; did you mean 'cartpole'?"),
        (
            ["myosuite_walk"],
            "policies/ has no policy for myosuite_walk: write --agent zero, random, or a policy's path",
        ),
        (["ant", "--agent", "cartpole", "--device", "cpu"], "acts in the task cartpole, not in ant: leave TASK out"),
        (["ant_hard", "--agent", "zero"], "ant_hard is a policy in policies/, not a task: leave --agent out"),
        (["--agent", "gone.pt"], "no checkpoint, trial or experiment 'gone.pt'"),
    ],
)
def test_tasks_and_agents_that_do_not_fit_are_refused(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DISPLAY", ":99")
    assert main(["play", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_a_policy_is_played_by_its_name_in_place_of_a_task(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also one of the user's own, in the current folder."""
    policies = tmp_path / "policies"
    policies.mkdir()
    shutil.copy(root / "policies" / "cartpole.pt", policies / "swinger.pt")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DISPLAY", ":99")
    screens: list[Screenshots] = []

    def screen(args: object, model: mujoco.MjModel, groups: object) -> AbstractContextManager[Screen]:
        screens.append(Screenshots(model, 10))
        return nullcontext(screens[-1])

    monkeypatch.setattr("msk_ray.play.__main__._screen", screen)
    words = ["--device", "cpu", "--episodes", "1", "--steps", "3", "--speed", "1000"]
    assert main(["play", "swinger", *words]) == 0
    said = capsys.readouterr().out
    assert f"playing {policies / 'swinger.pt'}" in said
    assert "episode 1: score" in said
    (shown,) = screens
    assert len(shown.shown) == 3


@pytest.fixture
def display() -> Iterator[str]:
    """A virtual display."""
    program = need_program("Xvfb", package="xvfb")
    ours, theirs = os.pipe()
    command = [program, "-displayfd", str(theirs), "-screen", "0", "640x480x24"]
    process = subprocess.Popen(command, pass_fds=[theirs], stderr=subprocess.DEVNULL)
    os.close(theirs)
    try:
        # It writes the display's number once it can be used.
        with os.fdopen(ours) as pipe:
            number = pipe.readline().strip()
        assert number, "Xvfb ended at once"
        yield f":{number}"
    finally:
        process.terminate()
        process.wait()


@pytest.mark.long
def test_the_viewer_shows_episodes_and_ends(sweep: Experiment, root: Path, display: str) -> None:
    folder = sweep.trial_folder(sweep.trials()[0].id)
    environment = os.environ | {"DISPLAY": display, "PYTHONPATH": str(root), "LIBGL_ALWAYS_SOFTWARE": "1"}
    for name in ("WAYLAND_DISPLAY", "MUJOCO_GL"):
        environment.pop(name, None)
    words = ["--agent", str(folder), "--episodes", "2", "--steps", "10", "--device", "cpu"]
    done = subprocess.run(
        [sys.executable, "-m", "msk_ray.play", *words], env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert said[-3] == "close the window to end"
    assert re.fullmatch(r"episode 2: score -\d+(\.\d+)?, 0\.2 s, time", said[-1])
