"""Whatever signal asks a sweep to stop, at whatever moment, to whichever process: all is saved, 75, nothing is left."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from needs import slow
from processes import Launcher, catches, members_of, wait_until
from stub_trainer import HELD_AT

from msk_ray.config import dump_yaml
from msk_ray.errors import ClusterLost
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.records import read_records
from msk_ray.signals import NUMBERS, RESUMABLE, listening
from msk_ray.tune import interrupts

pytestmark = pytest.mark.long

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    return Experiment(tmp_path / "runs" / "small")


@pytest.fixture
def start(space_data: dict[str, Any], tmp_path: Path, root: Path, launcher: Launcher) -> Start:
    """Starts the driver of trials, one for each rate, held at an epoch while a file exists."""
    space = tmp_path / "small.yaml"
    here = Path(__file__).parent
    command = [sys.executable, str(here / "stub_driver.py"), "--space", str(space), "--cpu"]
    (tmp_path / "hold").touch()

    def made(*more: str, rates: tuple[float, ...] = (0.01,), **environment: str) -> "subprocess.Popen[str]":
        space.write_text(dump_yaml(space_data | {"parameters": {"shac.actor_lr": {"grid": list(rates)}}}))
        paths = {"PYTHONPATH": os.pathsep.join([str(root), str(here)]), "STUB_HOLD": str(tmp_path / "hold")}
        return launcher.start(
            [*command, "--storage", str(tmp_path / "runs"), *more],
            env=os.environ | paths | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    return made


def held(experiment: Experiment, trials: int = 1) -> bool:
    return len(list(experiment.path.glob(f"trials/*/checkpoints/epoch_{HELD_AT:06d}.pt"))) == trials


@pytest.mark.parametrize("number", [signal.SIGTERM, *slow(signal.SIGUSR1)])
def test_a_signal_to_the_whole_group_lets_trials_save_themselves(
    number: signal.Signals, start: Start, experiment: Experiment, tmp_path: Path
) -> None:
    driver = start(rates=(0.01, 0.001))
    wait_until(lambda: held(experiment, 2), driver)
    os.killpg(driver.pid, number)
    output, _ = driver.communicate()
    assert driver.returncode == RESUMABLE, output
    assert f"{number.name}: 2 trials save themselves" in output
    for record in read_records(experiment):
        newest = sorted((record.folder / "checkpoints").glob("epoch_*.pt"))[-1]
        assert json.loads(newest.read_text())["epoch"] == record.epochs_done >= HELD_AT
    wait_until(lambda: not members_of(driver.pid))
    (tmp_path / "hold").unlink()
    again = start("--resume", rates=(0.01, 0.001))
    output, _ = again.communicate()
    assert again.returncode == 0, output
    assert [str(record.ending and record.ending.outcome) for record in read_records(experiment)] == ["finished"] * 2


def modules_load(driver: "subprocess.Popen[str]", tmp_path: Path) -> bool:
    return catches(driver.pid, signal.SIGHUP)  # the last one it listens to


def ray_starts(driver: "subprocess.Popen[str]", tmp_path: Path) -> bool:
    return "gcs_server" in members_of(driver.pid).values()


def kernels_are_compiled(driver: "subprocess.Popen[str]", tmp_path: Path) -> bool:
    return (tmp_path / "compiles").exists()


@pytest.mark.parametrize(
    ("moment", "number"),
    [(modules_load, signal.SIGTERM), (ray_starts, signal.SIGTERM), (kernels_are_compiled, signal.SIGUSR1)],
)
def test_a_signal_before_the_first_trial_is_a_request_to_stop_too(
    moment: Callable[..., bool], number: signal.Signals, start: Start, tmp_path: Path
) -> None:
    driver = start(STUB_COMPILES=str(tmp_path / "compiles"))
    wait_until(lambda: moment(driver, tmp_path), driver)
    os.killpg(driver.pid, number)
    output, _ = driver.communicate()
    assert driver.returncode == RESUMABLE, output
    assert f"stopped by {number.name}" in output
    if moment is not modules_load:
        assert "continue with: python stub_driver.py" in output
    wait_until(lambda: not members_of(driver.pid))


def well() -> Any:
    """Stands for a watch over a Ray that is well."""
    return SimpleNamespace(look=lambda passed_s: None)


def test_tune_takes_no_signal() -> None:
    from ray.tune.tune import _setup_signal_catching

    with listening() as stop:
        interrupts.run_in_thread(_setup_signal_catching, stop, well())
        assert [signal.getsignal(number) for number in NUMBERS] == [stop.receive] * len(NUMBERS)


def test_what_the_loop_raises_is_raised() -> None:
    def fail() -> None:
        raise ZeroDivisionError

    with listening() as stop, pytest.raises(ZeroDivisionError):
        interrupts.run_in_thread(fail, stop, well())


def test_a_loop_that_does_not_end_when_it_should_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interrupts, "_TICK_S", 0.01)
    monkeypatch.setattr(interrupts, "_LAST_WORD_S", 0.05)
    released = threading.Event()
    with listening() as stop, stop.deferred():
        stop.receive(signal.SIGTERM)
        with pytest.raises(ClusterLost, match="did not answer"):
            interrupts.run_in_thread(released.wait, stop, well())
    released.set()


def test_a_loop_that_waits_for_a_lost_ray_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interrupts, "_TICK_S", 0.01)
    released = threading.Event()
    watch: Any = SimpleNamespace(look=lambda passed_s: ClusterLost("it has died"))
    with listening() as stop, pytest.raises(ClusterLost, match="it has died"):
        interrupts.run_in_thread(released.wait, stop, watch)
    released.set()


def daemon_of(driver: "subprocess.Popen[str]", name: str) -> int:
    (pid,) = [pid for pid, of in members_of(driver.pid).items() if of == name]
    return pid


@pytest.mark.parametrize("name", ["gcs_server", *slow("raylet")])
def test_a_daemon_of_ray_that_dies_ends_the_sweep_resumably(name: str, start: Start, experiment: Experiment) -> None:
    driver = start()
    wait_until(lambda: held(experiment), driver)
    os.kill(daemon_of(driver, name), signal.SIGKILL)
    output, _ = driver.communicate()
    assert driver.returncode == RESUMABLE, output
    assert f"error: Ray's process {name} on this machine has died; continue with --resume\n" in output
    assert has_ended_in_order(output, driver, experiment)


@pytest.mark.parametrize("asked", [True, *slow(False)])
def test_a_ray_that_is_frozen_ends_the_sweep_resumably(asked: bool, start: Start, experiment: Experiment) -> None:
    driver = start(STUB_SILENCE="8")
    wait_until(lambda: held(experiment), driver)
    os.kill(daemon_of(driver, "gcs_server"), signal.SIGSTOP)
    if asked:
        os.kill(driver.pid, signal.SIGTERM)
    output, _ = driver.communicate()
    assert driver.returncode == RESUMABLE, output
    assert has_ended_in_order(output, driver, experiment)


def has_ended_in_order(output: str, driver: "subprocess.Popen[str]", experiment: Experiment) -> bool:
    """Whether a sweep has said how it goes on, and nothing of it is left."""
    wait_until(lambda: not members_of(driver.pid))
    assert not (experiment.path / "owner.json").exists()
    assert "Traceback" not in output
    return "continue with: python stub_driver.py" in output


def test_a_ray_that_does_not_end_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    released = threading.Event()
    monkeypatch.setattr(interrupts, "_SHUTDOWN_LIMIT_S", 0.05)
    monkeypatch.setattr(interrupts, "_LAST_POLL_S", 0.05)
    monkeypatch.setattr(interrupts.ray, "shutdown", released.wait)
    monkeypatch.setattr(interrupts.ray, "is_initialized", lambda: True)
    monkeypatch.setattr(interrupts.cli, "end_at_once", lambda: done.append("left"))
    folder: Any = SimpleNamespace(
        end_processes=lambda: done.append("processes ended"), close=lambda keep: done.append("closed")
    )
    with pytest.raises(ClusterLost, match="Ray did not end within"):
        interrupts.end_ray(folder)
    released.set()
    assert done == ["processes ended", "closed", "left"]


def test_a_folder_is_not_removed_before_ray_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """It makes a folder in there at its end, when this process counts as disconnected."""
    done: list[str] = []
    gone = threading.Event()

    def shut_down() -> None:
        gone.wait()  # for its daemons
        done.append("Ray ended")

    monkeypatch.setattr(interrupts.ray, "shutdown", shut_down)
    monkeypatch.setattr(interrupts.ray, "is_initialized", lambda: False)
    folder: Any = SimpleNamespace(end_processes=gone.set, close=lambda keep: done.append("closed"))
    interrupts.end_ray(folder)
    assert done == ["Ray ended", "closed"]


def test_a_signal_while_the_report_is_written(start: Start, experiment: Experiment, tmp_path: Path) -> None:
    """Ray's end takes the handler of SIGTERM away, in the kernel."""
    (tmp_path / "hold").unlink()
    driver = start()
    wait_until(lambda: (experiment.path / "summary.json").exists(), driver)
    assert driver.stdout is not None
    seen = ""
    while "writing the report" not in seen:
        seen += (line := driver.stdout.readline())
        assert line, seen
    os.kill(driver.pid, signal.SIGTERM)
    output, _ = driver.communicate()
    assert driver.returncode == RESUMABLE, seen + output
    assert "stopped by SIGTERM" in output
    assert has_ended_in_order(output, driver, experiment)


def test_ctrl_c_twice_leaves_no_process(start: Start, experiment: Experiment) -> None:
    driver = start()
    wait_until(lambda: held(experiment), driver)
    for pid in [pid for pid, name in members_of(driver.pid).items() if name == "ray::TrialActor"]:
        os.kill(pid, signal.SIGSTOP)  # so that no trial has saved itself before the second one
    os.kill(driver.pid, signal.SIGINT)
    assert driver.stdout is not None
    seen = ""
    while "save themselves" not in seen:
        seen += (line := driver.stdout.readline())
        assert line, seen
    os.kill(driver.pid, signal.SIGINT)
    driver.wait()
    # The driver has waited for them.
    assert members_of(driver.pid) == {}
    output = seen + driver.stdout.read()
    assert driver.returncode == 130, output
    assert output.endswith("interrupted\n")
    assert "Traceback" not in output


def test_the_start_of_ray_is_not_interrupted() -> None:
    """An exception raised between a fork and its end once left the lock of `logging` behind."""
    done = []

    def start_ray() -> None:
        with interrupts.starting_ray():
            os.kill(os.getpid(), signal.SIGINT)
            done.append(True)

    with listening() as stop:
        with pytest.raises(KeyboardInterrupt):
            start_ray()
        assert done
        assert stop.signal is signal.SIGINT


def test_rays_own_handler_is_heard_as_a_request() -> None:
    with listening() as stop, pytest.raises(KeyboardInterrupt), interrupts.starting_ray():
        sys.exit(signal.SIGTERM)
    assert stop.signal is signal.SIGTERM
