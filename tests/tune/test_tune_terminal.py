"""The driver outlives its terminal: SIGHUP is a request to stop, and a pipe nobody reads is nothing."""

import json
import os
import pty
import select
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from processes import Launcher, wait_until
from stub_trainer import HELD_AT

from msk_ray.config import dump_yaml
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.records import read_records
from msk_ray.signals import RESUMABLE

pytestmark = pytest.mark.long

EPOCHS = 150


@pytest.fixture
def command(space_data: dict[str, Any], tmp_path: Path) -> list[str]:
    """A sweep of one trial of a few seconds."""
    space = tmp_path / "small.yaml"
    one = {"parameters": {"shac.actor_lr": {"grid": [0.01]}}, "overrides": {"trial.epochs": EPOCHS}}
    space.write_text(dump_yaml(space_data | one))
    program = str(Path(__file__).with_name("stub_driver.py"))
    return [sys.executable, program, "--space", str(space), "--cpu", "--storage", str(tmp_path / "runs")]


@pytest.fixture(autouse=True)
def environment(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STUB_HOLD", str(tmp_path / "hold"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(root), str(Path(__file__).parent)]))


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    return Experiment(tmp_path / "runs" / "small")


def began(experiment: Experiment) -> bool:
    """Whether the trial has reached the epoch that it is held at."""
    return bool(list(experiment.path.glob(f"trials/*/checkpoints/epoch_{HELD_AT:06d}.pt")))


def whole(experiment: Experiment) -> bool:
    """Whether all trials have finished, with every epoch once."""
    records = read_records(experiment)
    return all(str(record.ending and record.ending.outcome) == "finished" for record in records) and all(
        [row["epoch"] for row in read_rows(record.folder)] == list(range(EPOCHS + 1)) for record in records
    )


def test_a_terminal_that_closes_lets_trials_save_themselves(
    command: list[str], experiment: Experiment, tmp_path: Path, launcher: Launcher
) -> None:
    hold = tmp_path / "hold"
    hold.touch()
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(command[0], command)
    launcher.adopt(pid)
    while not began(experiment):
        if select.select([terminal], [], [], 0.05)[0]:
            os.read(terminal, 4096)  # fails if it ended before
    # A window that is closed: its shell sends SIGHUP to all processes of the job, those of Ray too.
    os.killpg(pid, signal.SIGHUP)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == RESUMABLE
    assert (experiment.path / "summary.json").is_file()
    log = (experiment.path / "terminal.log").read_text()
    assert "nobody reads the output any more (Input/output error); it continues here" in log
    assert "SIGHUP: 1 trials save themselves" in log
    assert log.rstrip().endswith(f"continue with: python stub_driver.py {shlex.join(command[2:])} --resume")
    for record in read_records(experiment):
        # They saved themselves: the newest checkpoint is of the last epoch done, due or not.
        newest = sorted((record.folder / "checkpoints").glob("epoch_*.pt"))[-1]
        assert json.loads(newest.read_text())["epoch"] == record.epochs_done >= HELD_AT
    hold.unlink()
    assert subprocess.run([*command, "--resume"], capture_output=True).returncode == 0
    assert whole(experiment)


def test_a_pipe_that_nobody_reads_does_not_matter(
    command: list[str], experiment: Experiment, launcher: Launcher
) -> None:
    driver = launcher.start(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert driver.stdout is not None
    first = driver.stdout.readline()  # as `| head -1` does
    driver.stdout.close()
    assert driver.wait() == 0
    assert whole(experiment)
    log = (experiment.path / "terminal.log").read_text().splitlines()
    assert "nobody reads the output any more (Broken pipe)" in log[0]
    lines = [first.rstrip(), *log[1:]]
    # Nothing that was said is lost between the two, and the report's process, a child, says its line there too.
    assert sum("start  actor_lr=" in line for line in lines) == 1
    assert sum("finished: all 150 epochs done" in line for line in lines if line.startswith("[")) == 1
    assert any(line.startswith("best policy  ") for line in lines)
    assert any(line.startswith("report  ") for line in lines)


@pytest.mark.parametrize("redirection", [">&-", "| true"])
def test_no_line_is_lost_and_the_exit_code_is_its_own(redirection: str, tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from msk_ray.cli import surviving_closed_output\n"
        "with surviving_closed_output(Path('log')):\n"
        "    time.sleep(0.5)\n"
        "    print('a' * 100_000); print('ü', flush=True); print('to stderr', file=sys.stderr)\n"
        "print('after'); sys.exit(75)"
    )
    shell = f'set -o pipefail; "{sys.executable}" -c "$CODE" {redirection}'
    done = subprocess.run(
        ["bash", "-c", shell], env=os.environ | {"CODE": code}, cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (75, "to stderr\n")
    if redirection == "| true":
        lines = (tmp_path / "log").read_text(encoding="utf-8").splitlines()
        assert lines[1:] == ["a" * 100_000, "ü", "after"]
    else:
        assert not (tmp_path / "log").exists()


def test_nohup_keeps_its_word(command: list[str], experiment: Experiment, tmp_path: Path, launcher: Launcher) -> None:
    hold = tmp_path / "hold"
    hold.touch()
    driver = launcher.start(["nohup", *command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_until(lambda: began(experiment), driver)
    driver.send_signal(signal.SIGHUP)
    hold.unlink()
    assert driver.wait() == 0
    assert whole(experiment)
    assert not (experiment.path / "terminal.log").exists()
