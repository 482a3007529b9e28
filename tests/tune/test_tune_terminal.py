"""The driver outlives its terminal: SIGHUP is a request to stop, and a pipe nobody reads is nothing."""

import json
import os
import pty
import select
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from msk_ray.cli import RESUMABLE, StopRequest
from msk_ray.config import dump_yaml
from msk_ray.experiment.metrics import read_rows
from msk_ray.tune.experiment import Experiment
from msk_ray.tune.records import read_records

LIMIT_S = 120
EPOCHS = 150


@pytest.fixture
def command(space_data: dict[str, Any], tmp_path: Path) -> list[str]:
    """A sweep of two trials, a few seconds each."""
    space = tmp_path / "small.yaml"
    space.write_text(dump_yaml(space_data | {"overrides": {"trial.epochs": EPOCHS}}))
    program = str(Path(__file__).with_name("stub_driver.py"))
    return [sys.executable, program, "--space", str(space), "--cpu", "--storage", str(tmp_path / "runs")]


@pytest.fixture(autouse=True)
def environment(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(root), str(Path(__file__).parent)]))


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    return Experiment(tmp_path / "runs" / "small")


def began(experiment: Experiment) -> bool:
    return bool(list(experiment.path.glob("trials/*/checkpoints/epoch_000004.pt")))


def wait_until(condition: Any) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def whole(experiment: Experiment) -> bool:
    """Whether all trials have finished, with every epoch once."""
    records = read_records(experiment)
    return all(str(record.ending and record.ending.outcome) == "finished" for record in records) and all(
        [row["epoch"] for row in read_rows(record.folder)] == list(range(EPOCHS + 1)) for record in records
    )


def test_a_terminal_that_closes_lets_trials_save_themselves(command: list[str], experiment: Experiment) -> None:
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(command[0], command)
    seen = b""
    deadline = time.monotonic() + LIMIT_S
    while not began(experiment):
        assert time.monotonic() < deadline, seen.decode()
        if select.select([terminal], [], [], 0.05)[0]:
            seen += os.read(terminal, 4096)
    # A window that is closed: its shell sends SIGHUP to all processes of the job, those of Ray too.
    os.killpg(pid, signal.SIGHUP)
    os.close(terminal)
    wait_until(lambda: (experiment.path / "summary.json").is_file())
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == RESUMABLE
    log = (experiment.path / "terminal.log").read_text()
    assert "nobody reads the output any more (Input/output error); it goes on here" in log
    assert "SIGHUP: 2 trials save themselves" in log or "SIGHUP: 1 trials save themselves" in log
    assert log.rstrip().endswith(f"go on with: python stub_driver.py {shlex.join(command[2:])} --resume")
    for record in read_records(experiment):
        if record.epochs_done and record.ending is None:
            # They saved themselves: the newest checkpoint is of the last epoch done, due or not.
            newest = sorted((record.folder / "checkpoints").glob("epoch_*.pt"))[-1]
            assert json.loads(newest.read_text())["epoch"] == record.epochs_done
    assert subprocess.run([*command, "--resume"], capture_output=True, timeout=LIMIT_S).returncode == 0
    assert whole(experiment)


def test_a_pipe_that_nobody_reads_does_not_matter(command: list[str], experiment: Experiment) -> None:
    driver = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert driver.stdout is not None
    first = driver.stdout.readline()  # as `| head -1` does
    driver.stdout.close()
    assert driver.wait(LIMIT_S) == 0
    assert whole(experiment)
    log = (experiment.path / "terminal.log").read_text().splitlines()
    assert "nobody reads the output any more (Broken pipe)" in log[0]
    lines = [first.rstrip(), *log[1:]]
    # Nothing that was said is lost between the two, and the report's process, a child, says its line there too.
    assert sum("start  actor_lr=" in line for line in lines) == 2
    assert sum("finished: all 150 epochs done" in line for line in lines if line.startswith("[")) == 2
    assert any(line.startswith("best policy  ") for line in lines)
    assert any(line.startswith("report  ") for line in lines)


@pytest.mark.parametrize("redirection", [">&-", "| true"])
def test_no_line_is_lost_and_the_exit_code_is_its_own(redirection: str, tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from msk_ray.cli import outliving\n"
        "with outliving(Path('log')):\n"
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


def test_nohup_keeps_its_word(command: list[str], experiment: Experiment) -> None:
    driver = subprocess.Popen(["nohup", *command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_until(lambda: began(experiment))
    driver.send_signal(signal.SIGHUP)
    assert driver.wait(LIMIT_S) == 0
    assert whole(experiment)
    assert not (experiment.path / "terminal.log").exists()


@pytest.fixture
def handlers() -> Iterator[None]:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
    kept = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("ignored", [False, True])
def test_hangup_asks_to_stop_unless_it_is_ignored(ignored: bool, handlers: None) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    stop = StopRequest()
    stop.install()  # again, as after a library has taken signals
    os.kill(os.getpid(), signal.SIGHUP)
    assert bool(stop) is not ignored
    assert stop.signal is (None if ignored else signal.SIGHUP)
