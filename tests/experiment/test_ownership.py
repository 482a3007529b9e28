"""One owner at a time: by process here, by heartbeat elsewhere, and who was taken over notices."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from processes import Launcher, wait_until

from msk_ray.errors import OwnershipLost, StorageError, StorageFailure
from msk_ray.experiment import ownership
from msk_ray.experiment.ownership import LOCK_FILE, STALE_S, Owner, acquire, acquire_for, owned

HOLD = (
    "import sys; from pathlib import Path; from msk_ray.experiment.ownership import acquire\n"
    "acquire(Path(sys.argv[1])); input()"
)


@pytest.fixture
def held_by(tmp_path: Path, launcher: Launcher, root: Path) -> "subprocess.Popen[str]":
    """Another process of this machine that owns `tmp_path`."""
    process = launcher.start([sys.executable, "-c", HOLD, str(tmp_path)], cwd=root, stdin=subprocess.PIPE)
    wait_until((tmp_path / LOCK_FILE).exists, process)
    return process


def lock_of(folder: Path) -> Owner:
    return Owner(**json.loads((folder / LOCK_FILE).read_text()))


def hold_from_elsewhere(folder: Path, age_s: float, serves: str | None = None) -> Owner:
    """A lock of a process of another machine, last touched some time ago."""
    owner = Owner("node7", 4711, "123", "another boot", "token of node7", "2026-01-01 00:00:00", serves)
    (folder / LOCK_FILE).write_text(json.dumps(owner.__dict__))
    then = time.time() - age_s
    os.utime(folder / LOCK_FILE, (then, then))
    return owner


def test_an_owner_keeps_others_out_and_lets_them_in_when_it_goes(tmp_path: Path) -> None:
    with owned(tmp_path) as mine:
        assert lock_of(tmp_path).pid == os.getpid()
        mine.check(now=True)
        with pytest.raises(StorageError, match=f"in use by process {os.getpid()} on ") as caught:
            acquire(tmp_path)
        assert caught.value.exit_code == 2
        assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
    with owned(tmp_path):
        pass


def test_a_process_of_this_machine_is_known_to_live_or_not(held_by: "subprocess.Popen[str]", tmp_path: Path) -> None:
    long_ago = time.time() - 10 * STALE_S
    held_by.send_signal(signal.SIGSTOP)  # it no longer touches the lock; it lives all the same
    os.utime(tmp_path / LOCK_FILE, (long_ago, long_ago))
    with pytest.raises(StorageError, match=f"process {held_by.pid} on .*stop that first; --force takes it over$"):
        acquire(tmp_path)
    held_by.kill()
    held_by.wait()
    with owned(tmp_path):  # at once
        assert lock_of(tmp_path).pid == os.getpid()


def test_a_number_used_again_is_not_the_owner(tmp_path: Path) -> None:
    with owned(tmp_path) as mine:
        (tmp_path / LOCK_FILE).write_text(json.dumps(replace(mine.owner, birth="1", token="before").__dict__))
        with owned(tmp_path) as after:
            assert lock_of(tmp_path) == after.owner


def test_another_machine_is_judged_by_its_heartbeat(tmp_path: Path) -> None:
    hold_from_elsewhere(tmp_path, STALE_S - 20)
    with pytest.raises(StorageError, match=r"process 4711 on node7.*seen 4\d s ago.*wait \d+ s; --force takes it over"):
        acquire(tmp_path)
    assert lock_of(tmp_path).host == "node7"
    hold_from_elsewhere(tmp_path, STALE_S + 5)
    with owned(tmp_path):
        assert lock_of(tmp_path).pid == os.getpid()


def test_a_wrong_clock_makes_no_difference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hold_from_elsewhere(tmp_path, 10)
    monkeypatch.setattr(time, "time", lambda: 4e9)
    with pytest.raises(StorageError, match=r"seen 1\d s ago"):
        acquire(tmp_path)


def test_force_takes_over_and_the_other_one_stops(tmp_path: Path) -> None:
    with owned(tmp_path) as mine:
        theirs = acquire(tmp_path, force=True)
        with pytest.raises(OwnershipLost, match=f"taken over by process {os.getpid()}") as caught:
            mine.check(now=True)
        assert caught.value.exit_code == 75
    assert lock_of(tmp_path) == theirs.owner  # who was taken over leaves it alone
    theirs.check(now=True)
    theirs.release()


def test_a_lock_is_touched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ownership, "BEAT_S", 0.01)
    with owned(tmp_path):
        os.utime(tmp_path / LOCK_FILE, (0, 0))
        wait_until(lambda: (tmp_path / LOCK_FILE).stat().st_mtime > 0)


def test_a_loss_is_noticed_without_being_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ownership, "BEAT_S", 0.01)
    experiment, trial = tmp_path / "e", tmp_path / "e" / "t"
    trial.mkdir(parents=True)
    noticed = threading.Event()
    with owned(experiment) as driver:
        mine = acquire_for(trial, experiment, driver.owner.token, lambda lost: noticed.set())
        assert not noticed.wait(0.1)
        with owned(experiment, force=True):
            wait_until(noticed.is_set)
        with pytest.raises(OwnershipLost, match=r"is no longer its owner|does not exist"):
            mine.check()
        mine.release()


@pytest.mark.parametrize("disturb", [lambda lock: lock.unlink(), lambda lock: lock.write_text("{")])
def test_a_lock_that_is_gone_or_damaged_is_lost(disturb: Callable[[Path], None], tmp_path: Path) -> None:
    with owned(tmp_path) as mine:
        mine.check(now=True)
        disturb(tmp_path / LOCK_FILE)
        with pytest.raises(OwnershipLost):
            mine.check(now=True)


def test_a_storage_that_does_not_answer_is_borne_until_others_may_take_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreachable(folder: Path) -> str:
        raise TimeoutError(110, "Connection timed out")

    with owned(tmp_path) as mine:
        monkeypatch.setattr(ownership, "_token_in", unreachable)
        mine.check(now=True)
        monkeypatch.setattr(mine, "_seen", time.monotonic() - STALE_S)
        with pytest.raises(OwnershipLost, match="Connection timed out"):
            mine.check()
        monkeypatch.undo()


def test_a_trials_process_waits_for_the_one_before_it_and_serves_the_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment, trial = tmp_path / "e", tmp_path / "e" / "t"
    trial.mkdir(parents=True)
    monkeypatch.setattr(ownership, "_WAIT_S", 0.01)
    with owned(experiment) as driver:
        leftover = hold_from_elsewhere(trial, 0, serves="an earlier driver")
        with pytest.raises(StorageError, match="process 4711 on node7"):
            acquire_for(trial, experiment, driver.owner.token, lambda lost: None, patience_s=0.05)
        assert lock_of(trial) == leftover
        gone = threading.Timer(0.2, (trial / LOCK_FILE).unlink)
        gone.start()
        acquire_for(trial, experiment, driver.owner.token, lambda lost: None).release()
    # A process that a driver has started, and that begins when the driver is no longer the owner:
    with owned(experiment), pytest.raises(OwnershipLost):
        acquire_for(trial, experiment, driver.owner.token, lambda lost: None)
    assert not (trial / LOCK_FILE).exists()


def test_of_many_that_want_a_stale_lock_one_gets_it(tmp_path: Path, launcher: Launcher, root: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from msk_ray.experiment.ownership import acquire\n"
        "from msk_ray.errors import StorageError\n"
        "input()\n"
        "try: acquire(Path(sys.argv[1])); print('got it', flush=True)\n"
        "except StorageError: print('refused', flush=True)\n"
        "input()"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    rivals = [launcher.start([sys.executable, "-c", code, str(tmp_path)], cwd=root, **pipes) for _ in range(6)]
    hold_from_elsewhere(tmp_path, 2 * STALE_S)
    for rival in rivals:
        assert rival.stdin is not None
        rival.stdin.write("\n")
        rival.stdin.flush()
    answers = [rival.stdout.readline().strip() for rival in rivals if rival.stdout is not None]
    assert sorted(answers) == ["got it"] + ["refused"] * 5


def test_a_file_system_without_links_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(source: Path, target: Path) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_links)
    with owned(tmp_path) as mine:
        assert lock_of(tmp_path) == mine.owner
        with pytest.raises(StorageError):
            acquire(tmp_path)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(StorageFailure, match="No such file or directory"):
        acquire(tmp_path / "nowhere")
