"""What our own Ray on this machine exposes to others: its ports, its token, and its dashboard."""

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

import msk_ray
from msk_ray.errors import ClusterLost, StorageError

TOKEN_FILE = Path(".ray") / "auth_token"
"""Where Ray keeps the token of local sessions, relative to the home folder."""
STARTS = 3
"""How often Ray's daemons are started before giving up."""


def start_local(dashboard: bool | None, options: Mapping[str, Any]) -> Any:
    """Start a Ray for this process only, and connect to it.

    Args:
        dashboard: whether to start one; None starts it if its packages (ray[default]) are installed.
        options: for `ray.init`.

    Returns:
        The result of `ray.init`.

    Raises:
        ClusterLost: its daemons do not start, because the machine is too busy.
    """
    # Workers must import the package this process runs, wherever it was started from.
    package = str(Path(msk_ray.__file__).resolve().parent.parent)
    paths = [package, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(paths))
    # The dashboard finds its profiler among the programs of this environment, activated or not.
    programs = [*os.environ.get("PATH", os.defpath).split(os.pathsep), str(Path(sys.executable).parent)]
    os.environ["PATH"] = os.pathsep.join(dict.fromkeys(programs))
    timed_out: Exception | None = None
    for _ in range(STARTS):
        if timed_out is not None:
            print("Ray's daemons did not start within 30 s on this busy machine; starting them again ...", flush=True)
        try:
            with loopback_only():
                # By default Ray would join any cluster whose address a `ray start` on this machine has left behind.
                return ray.init("local", include_dashboard=dashboard, dashboard_host="127.0.0.1", **options)
        except Exception as error:
            # Ray has no class of its own for this, and no setting for how long it waits. What it has started ends with
            # this process.
            if "node timed out during startup" not in str(error):
                raise
            timed_out = error
    raise ClusterLost(
        f"Ray's daemons did not start within 30 s, {STARTS} times: this machine is too busy; try again later"
    ) from timed_out


@contextmanager
def loopback_only() -> Iterator[None]:
    """A Ray started inside this block listens only on the loopback interface.

    Ray gives every server the address of its node, for which it uses the machine's own address even if told 127.0.0.1;
    with the switch below, its default on macOS and Windows, it uses the loopback address. The switch is read from the
    environment when Ray is imported, so it is set here instead.
    """
    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


def make_token_private() -> None:
    """Create the token file of local sessions, or restrict the existing one, so that nobody else can read it.

    Anyone who has the token can run programs as this user, and Ray writes it with the permissions of an ordinary file.

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
    """How to log in to the dashboard of the Ray that this process uses, printed after its address."""
    if os.environ.get("RAY_AUTH_MODE", "").lower() != "token":
        return ""
    if os.environ.get("RAY_AUTH_TOKEN"):
        return " (asks once for the token: the one in RAY_AUTH_TOKEN)"
    path = os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / TOKEN_FILE
    return f" (asks once for the token: cat {path})"


def _own_token() -> bool:
    return bool(os.environ.get("RAY_AUTH_TOKEN") or os.environ.get("RAY_AUTH_TOKEN_PATH"))


def _make(path: Path) -> None:
    """Create the token unless it exists. It appears complete at once: another session may read it at any time."""
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)  # mode 0600
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(secrets.token_hex(32))
        # Another session may have been faster: its token is used.
        with suppress(FileExistsError):
            os.link(temporary, path)
    finally:
        os.unlink(temporary)
