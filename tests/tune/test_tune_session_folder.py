"""The folder of a Ray of our own: closed to other users of the machine, and gone afterwards."""

import os
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fault_campaign.other_user import as_another_user, attempts
from fault_campaign.processes import name_of
from processes import Launcher, members_of, wait_until

from msk_ray.errors import StorageError
from msk_ray.tune.session_folder import LINK, SessionFolder

FOLDER = """
import sys
from msk_ray.tune.session_folder import SessionFolder

folder = SessionFolder()
print("READY", flush=True)
sys.stdin.readline()
"""
SESSION = """
import os, sys
import ray
from msk_ray.tune.session import ray_session

@ray.remote
class Worker:
    def pid(self):
        return os.getpid()

with ray_session(None, trials=False):
    worker = Worker.remote()
    ray.get(worker.pid.remote())
    print("READY", flush=True)
    sys.stdin.readline()
try:
    ray.nodes()  # as a thread may that still runs
except Exception as error:
    print("refused:", error)
"""


@pytest.fixture
def top(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder like /tmp, where Ray is told to make its own; its path is short, for sockets."""
    with tempfile.TemporaryDirectory(prefix="t_", dir="/tmp") as folder:
        os.chmod(folder, 0o1777)
        monkeypatch.setenv("RAY_TMPDIR", folder)
        yield Path(folder)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


@pytest.fixture
def session(top: Path, home: Path, root: Path, launcher: Launcher) -> "subprocess.Popen[str]":
    """A process with a Ray of its own, a dashboard and a worker, until it reads a line."""
    return begin(SESSION, root, launcher)


def begin(code: str, root: Path, launcher: Launcher) -> "subprocess.Popen[str]":
    """A process that has said that it is ready."""
    process = launcher.start(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(root)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert process.stdout is not None
    lines = iter(process.stdout.readline, "")
    seen = []
    while (line := next(lines, "")) != "READY\n":
        assert line, "".join(seen)
        seen.append(line)
    return process


@pytest.mark.long
def test_another_user_reads_and_replaces_nothing_and_nothing_is_left_after_the_end(
    session: "subprocess.Popen[str]", top: Path, home: Path
) -> None:
    assert (home / LINK / "session_latest" / "logs").is_dir()
    assert (home / LINK).resolve().is_relative_to(top.resolve())
    if os.geteuid() == 0:  # only root can act as another user
        check_as_another_user(session, top, home)
    output, _ = session.communicate("\n")
    assert session.returncode == 0, output
    assert "refused: System error: Ray has not been started yet" in output
    wait_until(lambda: not members_of(session.pid))
    assert list(top.iterdir()) == []
    assert not os.path.lexists(home / LINK)


def check_as_another_user(session: "subprocess.Popen[str]", top: Path, home: Path) -> None:
    wait_until(lambda: list(top.rglob("prom_metrics_service_discovery.json")), session)
    paths = sorted(top.rglob("*"))
    kinds = {stat.S_IFMT(path.lstat().st_mode) for path in paths}
    assert {stat.S_IFSOCK, stat.S_IFDIR, stat.S_IFREG} <= kinds
    assert any(path.name == "raylet" for path in paths)
    assert as_another_user(lambda: attempts(paths, home)) == []
    # All that Ray shows by a name of its own lies in there: other users cannot make such names first.
    assert [path for path in top.iterdir() if not private(path)] == []
    # What it can do where there is no such folder.
    probe = top / "open"
    probe.mkdir()
    probe.chmod(0o777)
    (probe / "file").touch()
    assert f"renamed: {probe / 'file'}" in as_another_user(lambda: attempts([probe / "file"], home))
    shutil.rmtree(probe)


def private(path: Path) -> bool:
    facts = path.lstat()
    return stat.S_ISDIR(facts.st_mode) and stat.S_IMODE(facts.st_mode) == 0o700 and facts.st_uid == os.geteuid()


@pytest.mark.long
def test_nothing_is_left_of_a_driver_that_was_killed(session: "subprocess.Popen[str]", top: Path) -> None:
    """Ray's agents and the parts of its dashboard would stay for a while."""
    before = members_of(session.pid)
    assert "ray::RuntimeEnv" in before.values()
    session.kill()
    session.wait()
    wait_until(lambda: not any("ray" in name.lower() for name in members_of(session.pid).values()))
    wait_until(lambda: not members_of(session.pid))
    assert list(top.iterdir()) == []


def test_what_was_killed_together_with_its_keeper_is_removed_by_the_next_one(
    top: Path, home: Path, root: Path, launcher: Launcher
) -> None:
    session = begin(FOLDER, root, launcher)
    (left,) = top.iterdir()
    held = SessionFolder()
    assert left.is_dir()  # it is in use
    os.killpg(session.pid, signal.SIGKILL)
    session.wait()
    assert left.is_dir()
    held.close()
    SessionFolder().close()
    assert list(top.iterdir()) == []
    wait_until(lambda: not members_of(session.pid))


def test_a_folder_is_ones_own(top: Path, home: Path) -> None:
    folder = SessionFolder()
    assert private(folder.path)
    assert os.environ["RAY_TMPDIR"] == str(folder.path)
    folder.close()
    assert os.environ["RAY_TMPDIR"] == str(top)
    assert not folder.path.exists()
    kept = SessionFolder()
    kept.close(keep=True)
    kept.close()
    assert kept.path.is_dir()
    assert os.readlink(home / LINK) == str(kept.path / "ray")


def test_processes_of_the_folder_end_with_it_and_readers_do_not(top: Path, home: Path, launcher: Launcher) -> None:
    folder = SessionFolder()
    log = folder.path / "log"
    log.touch()
    sleep = [sys.executable, "-c", "import time; time.sleep(3600)"]
    started_with_it = launcher.start(sleep)
    with log.open() as file:
        reader = launcher.start(sleep, env={}, stdin=file)
    with log.open("w") as file:
        writer = launcher.start(sleep, env={}, stdout=file)
    wait_until(lambda: all(name_of(p.pid).startswith("python") for p in (started_with_it, reader, writer)))
    folder.close()
    assert (started_with_it.wait(), writer.wait()) == (-signal.SIGKILL, -signal.SIGKILL)
    assert reader.poll() is None


def test_a_cleanup_that_was_killed_is_done_here(top: Path, home: Path, launcher: Launcher) -> None:
    folder = SessionFolder()
    folder._cleanup.kill()
    started_with_it = launcher.start([sys.executable, "-c", "import time; time.sleep(3600)"])
    wait_until(lambda: name_of(started_with_it.pid).startswith("python"))
    folder.close()
    assert started_with_it.wait() == -signal.SIGKILL
    assert list(top.iterdir()) == []


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda path: path.chmod(0o777), r"other users can replace what is in"),
        (lambda path: path.rmdir(), "no such folder"),
    ],
    ids=["no sticky bit", "missing"],
)
def test_a_place_that_is_not_safe_is_refused(
    spoil: Callable[[Path], object], why: str, top: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = top / "p"
    place.mkdir()
    spoil(place)
    monkeypatch.setenv("RAY_TMPDIR", str(place))
    with pytest.raises(StorageError, match=rf"RAY_TMPDIR={place}: .*{why}.*; name another folder, or leave it out"):
        SessionFolder()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give folders away")
def test_a_place_of_another_user_is_refused(top: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = top / "p"
    place.mkdir()
    os.chown(place, 4711, 4711)
    monkeypatch.setenv("RAY_TMPDIR", str(place))
    with pytest.raises(StorageError, match="belongs to another user"):
        SessionFolder()


def test_a_path_too_long_for_sockets_is_refused_or_passed_over(
    top: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = top / "much_too_long_for_a_socket"
    place.mkdir()
    monkeypatch.setenv("RAY_TMPDIR", str(place))
    with pytest.raises(StorageError, match=r"too long for Ray's sockets, which leave \d+ characters"):
        SessionFolder()
    monkeypatch.delenv("RAY_TMPDIR")
    monkeypatch.setenv("TMPDIR", str(place))
    folder = SessionFolder()
    assert folder.path.parent == Path("/tmp")
    folder.close()
    assert "RAY_TMPDIR" not in os.environ
