"""Two drivers at one experiment, a driver that is frozen, and processes left over from a killed one."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from processes import Launcher, members_of, wait_until
from stub_trainer import HELD_AT

from msk_ray.config import dump_yaml
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.records import read_records
from msk_ray.signals import RESUMABLE

pytestmark = pytest.mark.long

EPOCHS = 20
HANG_S = 10.0

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    return Experiment(tmp_path / "runs" / "small")


@pytest.fixture
def start(space_data: dict[str, Any], tmp_path: Path, root: Path, launcher: Launcher) -> Start:
    """Starts a driver of one trial, held at an epoch while a file exists."""
    space = tmp_path / "small.yaml"
    one = {"parameters": {"shac.actor_lr": {"grid": [0.01]}}}
    space.write_text(dump_yaml(space_data | one | {"resources": {"hang_s": HANG_S}}))
    here = Path(__file__).parent
    command = [sys.executable, str(here / "stub_driver.py"), "--space", str(space), "--cpu"]

    def made(*more: str) -> "subprocess.Popen[str]":
        paths = {"PYTHONPATH": os.pathsep.join([str(root), str(here)]), "STUB_HOLD": str(tmp_path / "hold")}
        return launcher.start(
            [*command, "--storage", str(tmp_path / "runs"), *more],
            env=os.environ | paths,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    return made


def reached(experiment: Experiment, epoch: int) -> bool:
    return bool(list(experiment.path.glob(f"trials/*/checkpoints/epoch_{epoch:06d}.pt")))


def whole(experiment: Experiment) -> bool:
    """Whether all trials have finished, with every epoch once."""
    records = read_records(experiment)
    return all(str(record.ending and record.ending.outcome) == "finished" for record in records) and all(
        [row["epoch"] for row in read_rows(record.folder)] == list(range(EPOCHS + 1)) for record in records
    )


def test_a_second_driver_is_refused_one_that_is_forced_takes_over_and_a_killed_one_is_known_to_be_dead_at_once(
    start: Start, experiment: Experiment, tmp_path: Path
) -> None:
    (tmp_path / "hold").touch()
    first = start("--halve-worlds")
    wait_until(lambda: reached(experiment, HELD_AT), first)
    kept = {name: (experiment.path / name).read_bytes() for name in ("manifest.json", "space.yaml", "owner.json")}
    second = start("--resume", "--no-halve-worlds")
    output, _ = second.communicate()
    assert second.returncode == 2
    refusal = (
        rf"error: \S+ is in use by process {first.pid} on \S+, at work since .*, seen \d+ s ago: stop that first; "
    )
    assert re.fullmatch(refusal + "--force takes it over\n", output)
    assert {name: (experiment.path / name).read_bytes() for name in kept} == kept
    assert not experiment.stop_file.exists()
    assert first.poll() is None
    third = start("--resume", "--force")
    output, _ = first.communicate()
    assert first.returncode == RESUMABLE, output
    assert f"has been taken over by process {third.pid} on" in output.splitlines()[-1]
    assert not experiment.stop_file.exists()
    wait_until(lambda: not members_of(first.pid))
    (record,) = read_records(experiment)
    wait_until(lambda: len((record.folder / "processes").read_text().split()) == 2, third)
    third.kill()
    third.wait()
    (tmp_path / "hold").unlink()
    fourth = start("--resume")  # the process of the trial may still be there
    output, _ = fourth.communicate()
    assert fourth.returncode == 0, output
    assert whole(experiment)
    assert not (experiment.path / "owner.json").exists()
    assert not list(experiment.path.glob("trials/*/owner.json"))


def test_a_trial_that_waits_for_a_frozen_driver_does_not_hang(start: Start, experiment: Experiment) -> None:
    driver = start()
    wait_until(lambda: reached(experiment, 4), driver)
    driver.send_signal(signal.SIGSTOP)
    time.sleep(2.5 * HANG_S)  # no deadline: the longer, the stricter
    driver.send_signal(signal.SIGCONT)
    output, _ = driver.communicate()
    assert driver.returncode == 0, output
    assert whole(experiment)
    assert "hung" not in output
    for record in read_records(experiment):
        assert len((record.folder / "processes").read_text().split()) == 1  # each trial had one process
