"""How our own Ray on this machine is started, and its access from outside: ports, token, dashboard."""

import os
import secrets
import stat
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import ray
from ray._private import ray_constants

from msk_ray.errors import ClusterLost, StorageError
from msk_ray.registry import python_path

TOKEN_FILE = Path(".ray") / "auth_token"
"""Where Ray keeps the token of local sessions, relative to the home folder."""
STARTS = 3
"""How often to try to start Ray's daemons."""


def start_local(dashboard: bool | None, options: Mapping[str, Any]) -> Any:
    """Start a Ray for this process only, and connect to it.

    Args:
        dashboard: whether to start one; None: only if its packages (ray[default]) are installed.
        options: arguments of `ray.init`.

    Returns:
        The result of `ray.init`.

    Raises:
        ClusterLost: its daemons do not start in time, because the machine is too busy.
    """
    # Workers must import the same package as this process.
    os.environ["PYTHONPATH"] = python_path()
    # The dashboard looks for its profiler in PATH; this environment may not be activated.
    programs = [*os.environ.get("PATH", os.defpath).split(os.pathsep), str(Path(sys.executable).parent)]
    os.environ["PATH"] = os.pathsep.join(dict.fromkeys(programs))
    timed_out: Exception | None = None
    for _ in range(STARTS):
        if timed_out is not None:
            print("Ray's daemons did not start within 30 s on this busy machine; starting them again ...", flush=True)
        try:
            with loopback_only():
                # By default Ray would join a cluster whose address a `ray start` on this machine has left behind.
                return ray.init("local", include_dashboard=dashboard, dashboard_host="127.0.0.1", **options)
        except Exception as error:
            # Ray has no exception class for this, and no setting for the timeout. What it has started ends with this
            # process.
            if "node timed out during startup" not in str(error):
                raise
            timed_out = error
    raise ClusterLost(
        f"Ray's daemons did not start within 30 s, {STARTS} times: this machine is too busy; try again later"
    ) from timed_out


@contextmanager
def loopback_only() -> Iterator[None]:
    """A Ray started inside this block listens only on the loopback interface.

    Ray's servers listen on the node's address, which is the machine's own address even if told 127.0.0.1. With the
    switch below, the default on macOS and Windows, it is the loopback address. Ray reads the switch from the
    environment only when it is imported, so set it in Ray's module here.
    """
    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


def make_token_private() -> None:
    """Create the token file of local sessions, or restrict its permissions, so that nobody else can read it.

    Anyone with the token can run programs as this user, but Ray writes it readable for others.

    Raises:
        StorageError: the file cannot be written, or belongs to another user.
    """
    mode = os.environ.get("RAY_AUTH_MODE")
    if (mode is not None and mode.lower() != "token") or _own_token():
        return
    path = Path.home() / TOKEN_FILE
    try:
        _make(path)
        if stat.S_IMODE(path.stat().st_mode) & 0o077:
            path.chmod(0o600)
            print(
                f"{path} could be read by other users of this machine until now. To replace it: remove it while no Ray "
                "runs, and the next session makes another",
                flush=True,
            )
    except OSError as error:
        raise StorageError(
            f"cannot keep Ray's token in {path}: {error.strerror or error}; "
            "point RAY_AUTH_TOKEN_PATH to a file of your own that holds a token"
        ) from error


def way_in() -> str:
    """How to log in to the dashboard, to print after its address."""
    if os.environ.get("RAY_AUTH_MODE", "").lower() != "token":
        return ""
    if os.environ.get("RAY_AUTH_TOKEN"):
        return " (asks once for the token: the one in RAY_AUTH_TOKEN)"
    path = os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / TOKEN_FILE
    return f" (asks once for the token: cat {path})"


def _own_token() -> bool:
    return bool(os.environ.get("RAY_AUTH_TOKEN") or os.environ.get("RAY_AUTH_TOKEN_PATH"))


def _make(path: Path) -> None:
    """Create the token file unless it exists, atomically: another session may read it at any time."""
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)  # mode 0600
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(secrets.token_hex(32))
        # If another session was faster, use its token.
        with suppress(FileExistsError):
            os.link(temporary, path)
    finally:
        os.unlink(temporary)
