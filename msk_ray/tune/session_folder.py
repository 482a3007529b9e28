"""The folder of the files of our own Ray, which only its owner can enter, and which is always removed.

Ray creates its folders with mode 0777, and trusts the sockets, logs and service files in them. So it gets a folder
inside one that other users of the machine cannot enter.
"""

import fcntl
import os
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

from msk_ray.errors import StorageError
from msk_ray.signals import NUMBERS
from msk_ray.tune import cleanup

VARIABLE = "RAY_TMPDIR"
"""Environment variable: the folder in which Ray, and everything it starts, creates its folder `ray`."""
PREFIX = "msk-"
LINK = Path(".ray") / "latest"
"""Link to the folder of this user's newest Ray session, relative to the home folder."""
MODE = 0o700
_SOCKET_BYTES = 107
"""Maximum length of a socket's path."""
_LONGEST_SOCKET = "ray/session_2026-11-24_11-19-09_123456_4194304/sockets/dash_TaskEventsHead"
"""Part of the path that Ray adds, with the largest process id that Linux has."""
_RANDOM_CHARACTERS = 8
"""Length of what `tempfile.mkdtemp` adds to the prefix."""
_CLEANUP_LIMIT_S = 30.0


class SessionFolder:
    """A new folder for one Ray session, and a process that cleans up after this one, however it ends.

    The cleaning process kills all processes that were started with this folder, and removes the folder. While it or
    this process lives, one of them holds a lock on the folder; the same user's next sweep removes folders without a
    lock.

    Attributes:
        path: the folder.
    """

    def __init__(self) -> None:
        """
        Raises:
            StorageError: there is no suitable place for it.
        """
        parent = _parent()
        _remove_abandoned(parent)
        try:
            self.path, self._lock = _make(parent)
            self._cleanup = _start_cleanup(self.path, self._lock)
        except OSError as error:
            raise StorageError(
                f"cannot make a folder for Ray in {parent}: {error.strerror}; let {VARIABLE} name another one"
            ) from error
        self._before = os.environ.get(VARIABLE)
        os.environ[VARIABLE] = str(self.path)
        self._link()

    @property
    def logs(self) -> Path:
        """Folder of Ray's logs."""
        return self.path / "ray" / "session_latest" / "logs"

    def end_processes(self) -> None:
        """Kill this folder's processes, except this one and the cleaning process."""
        cleanup.end_processes(self.path, {os.getpid(), self._cleanup.pid})

    def close(self, keep: bool = False) -> None:
        """Kill this folder's processes and remove it; does nothing the second time.

        Args:
            keep: keep the folder, with Ray's logs, until this user's next sweep.
        """
        if self._cleanup.stdin is None:
            return
        with suppress(BrokenPipeError):  # someone has killed it
            if keep:
                self._cleanup.stdin.write(cleanup.KEEP)
            self._cleanup.stdin.close()
        self._cleanup.stdin = None
        try:
            code = self._cleanup.wait(_CLEANUP_LIMIT_S)
        except subprocess.TimeoutExpired:  # someone has suspended it
            self._cleanup.kill()
            code = self._cleanup.wait()
        if code:
            self.end_processes()
            if not keep:
                shutil.rmtree(self.path, ignore_errors=True)
        if self._before is None:
            os.environ.pop(VARIABLE, None)
        else:
            os.environ[VARIABLE] = self._before
        if not keep:
            self._unlink()
        os.close(self._lock)

    def _link(self) -> None:
        """Let `~/.ray/latest` point to Ray's files, because the folder's name changes each time."""
        link = Path.home() / LINK
        try:
            link.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=".latest.", dir=link.parent) as beside:
                (Path(beside) / "link").symlink_to(self.path / "ray")
                os.replace(Path(beside) / "link", link)
        except OSError as error:
            print(f"{link} does not lead to Ray's files in {self.path}: {error.strerror}", flush=True)

    def _unlink(self) -> None:
        link = Path.home() / LINK
        with suppress(OSError):  # it is gone, or was never created
            if os.readlink(link) == str(self.path / "ray"):
                link.unlink()


def _parent() -> Path:
    """The parent for session folders: RAY_TMPDIR if set, otherwise TMPDIR or /tmp.

    Raises:
        StorageError: none of them is suitable.
    """
    named = os.environ.get(VARIABLE)
    if named:
        fault = _unfit(Path(named))
        if fault is not None:
            raise StorageError(f"{VARIABLE}={named}: {fault}; name another folder, or leave it out")
        return Path(named).resolve()
    faults = []
    for place in filter(None, (os.environ.get("TMPDIR"), "/tmp")):
        fault = _unfit(Path(place))
        if fault is None:
            return Path(place).resolve()
        faults.append(f"{place}: {fault}")
    raise StorageError(f"no folder is fit for Ray's files ({'; '.join(faults)}); let {VARIABLE} name one")


def _unfit(place: Path) -> str | None:
    """Why Ray's folder cannot be created in this one; None if it can."""
    if not place.is_absolute():
        return "not an absolute path"
    if not place.is_dir():
        return "no such folder"
    place = place.resolve()
    longest = _SOCKET_BYTES - len(f"/{PREFIX}/{_LONGEST_SOCKET}") - _RANDOM_CHARACTERS
    if len(os.fsencode(place)) > longest:
        return f"too long for Ray's sockets, which leave {longest} characters"
    if not os.access(place, os.W_OK | os.X_OK):
        return "not writable"
    for folder in (place, *place.parents):
        facts = folder.stat()
        if facts.st_uid not in (0, os.geteuid(), _unmapped()):
            return f"{folder} belongs to another user, who could replace what is in it"
        if facts.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not facts.st_mode & stat.S_ISVTX:
            return f"other users can replace what is in {folder}"
    return None


def _unmapped() -> int:
    """User id that owns, inside a container, the files of users unknown to it, such as the host's root."""
    return int(Path("/proc/sys/kernel/overflowuid").read_text())


def _make(parent: Path) -> tuple[Path, int]:
    """Create a folder that only this user can enter, with a lock; returns the lock's descriptor too."""
    while True:
        path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))  # mode 0700
        with suppress(FileNotFoundError):  # another sweep has removed it as abandoned
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            fcntl.flock(lock, fcntl.LOCK_EX)
            if os.path.exists(path) and os.path.samestat(os.fstat(lock), path.lstat()):
                return path, lock
            os.close(lock)


def _remove_abandoned(parent: Path) -> None:
    """Remove folders of this user's sweeps that were killed together with their cleaning process."""
    for path in parent.glob(f"{PREFIX}{'?' * _RANDOM_CHARACTERS}"):
        try:
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError:
            continue  # another user's, or no folder
        try:
            facts = os.fstat(lock)
            if facts.st_uid != os.geteuid() or stat.S_IMODE(facts.st_mode) != MODE:
                continue
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            cleanup.end_processes(path, {os.getpid()})
            shutil.rmtree(path, ignore_errors=True)
        except BlockingIOError:
            pass  # in use
        finally:
            os.close(lock)


def _start_cleanup(path: Path, lock: int) -> "subprocess.Popen[bytes]":
    """Start the cleaning process, which keeps the lock, and imports only the standard library."""
    # It ignores signals, but not yet while it starts.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {*NUMBERS, signal.SIGTSTP})
    try:
        return subprocess.Popen(
            [sys.executable, "-I", "-S", cleanup.__file__, str(path), str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=[lock],
            cwd="/",
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
