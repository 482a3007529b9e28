"""Ray's dashboard during a sweep: the line in the terminal lets one in, and trials are found by their labels."""

import os
import re
import shlex
import subprocess
import sys
import traceback
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from processes import Launcher

from msk_ray.config import dump_yaml
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.records import read_records
from msk_ray.signals import RESUMABLE
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune.trainable import in_frame_named

pytestmark = pytest.mark.long

LIMIT_MS = 300_000
"""How long a page may take on a busy machine [ms]; only a failure takes so long."""


@pytest.fixture
def driver(
    space_data: dict[str, Any], tmp_path: Path, root: Path, launcher: Launcher, monkeypatch: pytest.MonkeyPatch
) -> "subprocess.Popen[str]":
    """A sweep that runs until it is stopped, in a home folder without a token."""
    for name in ("RAY_ADDRESS", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("STUB_DASHBOARD", "1")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(root), str(Path(__file__).parent)]))
    rates = {"shac.actor_lr": {"grid": [{"label": "slow → fast", "value": 0.01}, 0.001]}}
    space = tmp_path / "small.yaml"
    space.write_text(dump_yaml(space_data | {"parameters": rates, "overrides": {"trial.epochs": 1_000_000}}))
    program = str(Path(__file__).with_name("stub_driver.py"))
    command = [sys.executable, program, "--space", str(space), "--cpu", "--storage", str(tmp_path / "runs")]
    return launcher.start(command, stdout=subprocess.PIPE)


def line_with(driver: "subprocess.Popen[str]", text: str) -> str:
    """The next line of output that holds `text`."""
    assert driver.stdout is not None
    for line in driver.stdout:
        if text in line:
            return line.strip()
    pytest.fail(f"the driver ended ({driver.wait()}) before it said {text!r}")


def get_in(page: Page, line: str) -> None:
    """Do what the terminal's line says."""
    shown = re.fullmatch(r"Ray dashboard: (\S+) \(asks once for the token: (.+)\)", line)
    assert shown is not None, line
    address, command = shown.groups()
    page.goto(address)
    expect(page.get_by_text("Authentication Token Required")).to_be_visible(timeout=LIMIT_MS)
    token = subprocess.run(shlex.split(command), capture_output=True, text=True, check=True).stdout
    page.get_by_label("Authentication Token", exact=True).fill(token)
    page.get_by_role("button", name="Submit").click()
    expect(page.get_by_text("Authentication Token Required")).to_be_hidden(timeout=LIMIT_MS)
    page.goto(f"{address}/#/actors")


def test_the_terminal_lets_one_in_and_a_running_trial_is_found_by_its_label(
    driver: "subprocess.Popen[str]", browser: Any, tmp_path: Path
) -> None:
    dashboard = line_with(driver, "Ray dashboard")
    line_with(driver, "best so far")  # a trial trains
    trials = [record.trial for record in read_records(Experiment(tmp_path / "runs" / "small"))]
    context = browser.new_context(viewport={"width": 1600, "height": 900})
    page = context.new_page()
    get_in(page, dashboard)
    for trial in trials:
        assert trial.label == f"{trial.id} {trial.variant} seed=0"
        row = page.get_by_role("row").filter(has_text=trial.label)
        expect(row).to_have_count(1, timeout=LIMIT_MS)
        expect(row).to_contain_text("TrialActor")
        expect(row).to_contain_text("ALIVE", timeout=LIMIT_MS)
    assert "slow → fast" in trials[0].label
    context.close()
    driver.terminate()
    assert driver.stdout is not None
    rest = driver.stdout.read()
    assert driver.wait() == RESUMABLE
    token = (tmp_path / "home" / ".ray" / "auth_token").read_text()
    assert token not in rest


def test_a_profile_shows_which_trial_it_is_of() -> None:
    frames: list[str] = []
    in_frame_named("40ed2476 horizon=8 seed=0", lambda: frames.extend(f.name for f in traceback.extract_stack()))
    assert frames[-2] == "40ed2476 horizon=8 seed=0"


def test_a_label_is_one_line_that_profiles_can_hold(make_space: Any) -> None:
    rates = {"shac.actor_lr": {"grid": [{"label": "a;b\n\x1b[2Jc → d", "value": 0.01}]}}
    (trial,) = resolve_trials(make_space(parameters=rates))
    assert trial.label == f"{trial.id} actor_lr=a,b\\n\\x1b[2Jc → d seed=0"
