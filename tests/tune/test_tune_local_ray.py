"""A Ray of our own on this machine: what it shows to the network and to other users of the machine."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from msk_ray.errors import ClusterLost, StorageError
from msk_ray.tune import local_ray, session

pytestmark = pytest.mark.long

SESSION = """
import ipaddress, json, os, shutil, sys
import ray, psutil
from msk_ray.tune.session import ray_session

@ray.remote
def token_file():
    path = os.path.expanduser("~/.ray/auth_token")
    return os.stat(path).st_mode & 0o777

@ray.remote
def profiler():
    return shutil.which("py-spy")

with ray_session(None, trials=False):
    mode = ray.get(token_file.remote())
    profiler_found = ray.get(profiler.remote()) is not None
    open_to_others = []
    listening = 0
    me = psutil.Process()
    for process in [me, *me.children(recursive=True)]:
        for socket in process.net_connections("inet"):
            if socket.status != psutil.CONN_LISTEN:
                continue
            listening += 1
            address = ipaddress.ip_address(socket.laddr.ip)
            if not (getattr(address, "ipv4_mapped", None) or address).is_loopback:
                open_to_others.append([" ".join(process.cmdline())[:80], socket.laddr.ip, socket.laddr.port])
    facts = {"mode": mode, "listening": listening, "open": open_to_others, "profiler": profiler_found}
    print("FACTS", json.dumps(facts))
"""

WITHOUT_DASHBOARD = """
import sys
sys.modules["aiohttp_cors"] = None  # as if ray[default] were not installed
from msk_ray.tune.session import ray_session

with ray_session(None, trials=False):
    pass
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home folder without a token, and an environment that names none."""
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def permissions(path: Path) -> int:
    return path.stat().st_mode & 0o777


def test_a_session_is_closed_to_the_network_and_its_token_to_other_users(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", os.defpath)  # as in an environment that was not activated
    result = subprocess.run([sys.executable, "-c", SESSION], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    beginning, first, *_, last = result.stdout.strip().splitlines()
    assert beginning == "starting Ray ..."
    facts = json.loads(last.removeprefix("FACTS "))
    assert facts["listening"] >= 8  # gcs_server, raylet, dashboard, agents, workers
    assert facts["open"] == []
    assert facts["mode"] == 0o600
    assert facts["profiler"]
    # The terminal says how to get in, without the token itself.
    token = home / ".ray" / "auth_token"
    assert first.startswith("Ray dashboard: http://127.0.0.1:")
    assert first.endswith(f" (asks once for the token: cat {token})")
    assert token.read_text() not in result.stdout + result.stderr


def test_one_line_says_that_there_is_no_dashboard(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(session, "_init", lambda *args: SimpleNamespace(dashboard_url=""))
    with session.ray_session(None, trials=False):
        pass
    assert capsys.readouterr().out.splitlines()[1:] == ["no Ray dashboard: pip install 'ray[default]' to have one"]


@pytest.mark.slow
def test_ray_starts_without_what_its_dashboard_needs(home: Path) -> None:
    result = subprocess.run([sys.executable, "-c", WITHOUT_DASHBOARD], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[1:] == ["no Ray dashboard: pip install 'ray[default]' to have one"]


def test_a_token_is_made_once_by_all_who_start_together(home: Path) -> None:
    barrier = threading.Barrier(8)

    def make() -> None:
        barrier.wait()
        local_ray.make_token_private()
        seen.append((home / ".ray" / "auth_token").read_text())

    seen: list[str] = []
    threads = [threading.Thread(target=make) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(seen) == 8
    assert len(set(seen)) == 1
    assert len(seen[0]) == 64
    assert permissions(home / ".ray" / "auth_token") == 0o600
    assert [path.name for path in (home / ".ray").iterdir()] == ["auth_token"]


def test_a_token_that_others_could_read_is_tightened_and_kept(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = home / ".ray" / "auth_token"
    path.parent.mkdir()
    path.write_text("known")
    path.chmod(0o644)
    local_ray.make_token_private()
    assert permissions(path) == 0o600
    assert path.read_text() == "known"  # another session may be using it
    assert "could be read by other users of this machine until now" in capsys.readouterr().out
    local_ray.make_token_private()
    assert capsys.readouterr().out == ""


def test_a_token_that_cannot_be_kept_is_refused_in_one_line(home: Path) -> None:
    (home / ".ray").write_text("a file where the folder should be")
    with pytest.raises(StorageError, match=r"cannot keep Ray's token in .*; point RAY_AUTH_TOKEN_PATH to a file"):
        local_ray.make_token_private()


@pytest.mark.parametrize(
    "variables",
    [{"RAY_AUTH_MODE": "disabled"}, {"RAY_AUTH_TOKEN": "t"}, {"RAY_AUTH_TOKEN_PATH": "/elsewhere"}],
    ids=["disabled", "in the environment", "in a file of one's own"],
)
def test_no_token_is_made_where_it_is_not_used(
    home: Path, monkeypatch: pytest.MonkeyPatch, variables: dict[str, str]
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    local_ray.make_token_private()
    assert os.listdir(home) == []


@pytest.mark.parametrize(
    ("variables", "line"),
    [
        ({}, ""),
        ({"RAY_AUTH_MODE": "disabled"}, ""),
        ({"RAY_AUTH_MODE": "token"}, " (asks once for the token: cat HOME/.ray/auth_token)"),
        ({"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": "/a/b"}, " (asks once for the token: cat /a/b)"),
        (
            {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "t", "RAY_AUTH_TOKEN_PATH": "/a/b"},
            " (asks once for the token: the one in RAY_AUTH_TOKEN)",
        ),
    ],
)
def test_the_way_in(home: Path, monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], line: str) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert local_ray.way_in() == line.replace("HOME", str(home))


class Starts:
    """Stands for `ray.init`: it fails a number of times."""

    def __init__(self, failures: int, message: str) -> None:
        self.failures, self.message, self.calls = failures, message, 0

    def __call__(self, *args: object, **options: object) -> str:
        self.calls += 1
        if self.calls <= self.failures:
            raise Exception(self.message)
        return "context"


TIMED_OUT = "The current node timed out during startup. This could happen because the GCS has become overloaded."


def test_daemons_that_are_too_slow_are_started_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(local_ray, "make_token_private", lambda: None)
    starts = Starts(2, TIMED_OUT)
    monkeypatch.setattr(local_ray.ray, "init", starts)
    assert local_ray.start_local(False, {}) == "context"
    assert starts.calls == 3
    assert capsys.readouterr().out.count("starting them again") == 2


@pytest.mark.parametrize(
    ("message", "error", "calls"), [(TIMED_OUT, ClusterLost, local_ray.STARTS), ("something else", Exception, 1)]
)
def test_what_does_not_start_is_an_error(
    message: str, error: type[Exception], calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_ray, "make_token_private", lambda: None)
    starts = Starts(100, message)
    monkeypatch.setattr(local_ray.ray, "init", starts)
    with pytest.raises(error):
        local_ray.start_local(False, {})
    assert starts.calls == calls
