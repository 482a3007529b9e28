"""One owner at a time for a folder: a process that writes an experiment, a trial or a training run holds its lock.

The lock is a file, `owner.json`, that names its owner and that the owner touches every `BEAT_S`. It works on shared
storage and does not outlive its owner:

- It is created atomically: written under another name, then linked to its name, which fails if the name is taken.
  `flock` is not used, because some shared file systems lack it.
- An owner on this machine is looked up among the processes by number and start time, so that a killed one is known to
  be dead at once. An owner on another machine is judged by the age of the lock's last touch: stale after `STALE_S`.
  Both times that this needs, the touch and now, come from the file server; the clocks of the hosts do not matter.
- A process that finds a stale lock renames it, checks that it is still the one it read, and links its own. An owner
  wrongly taken for dead, perhaps because it was frozen, finds another name in the file, or none, and must stop
  (`Ownership.check`) without touching anything.
"""

import contextlib
import json
import os
import platform
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from msk_ray.errors import OwnershipLost, StorageError, StorageFailure
from msk_ray.experiment.damage import RECORD, field, parse_object
from msk_ray.files import UnusableFile, open_file

LOCK_FILE = "owner.json"
BEAT_S = 5.0
"""Time between two touches of a lock [s]."""
STALE_S = 60.0
"""Age of the last touch after which an owner on another machine counts as dead [s]."""
_WAIT_S = 0.5
_CHECKED_S = 1.0
"""How long one check of the lock remains valid [s]."""


@dataclass(frozen=True)
class Owner:
    """Who holds a lock."""

    host: str
    pid: int
    birth: str
    """When the process was started, in the kernel's ticks since boot, because process numbers are reused."""
    machine: str
    """Boot and process-number namespace, within which `pid` is valid."""
    token: str
    """Random token of this lock."""
    began: str
    """Date and time, for people."""
    serves: str | None = None
    """For a trial's process: the token of the experiment's owner that started it."""

    def alive_here(self) -> bool | None:
        """Whether the process is alive; None if it belongs to another machine or container."""
        return _birth_of(self.pid) == self.birth if self.machine == _machine() else None


@dataclass(frozen=True)
class _Lock:
    """The lock in a folder, as read."""

    owner: Owner | None
    """None if the file is damaged; then only its age can be judged."""
    age_s: float

    @property
    def stale(self) -> bool:
        alive = None if self.owner is None else self.owner.alive_here()
        return self.age_s > STALE_S if alive is None else not alive

    def __str__(self) -> str:
        if self.owner is None:
            return f"{LOCK_FILE} is damaged, touched {self.age_s:.0f} s ago"
        who = f"process {self.owner.pid} on {self.owner.host}"
        return f"{who}, at work since {self.owner.began}, seen {self.age_s:.0f} s ago"


class Ownership:
    """A lock held by this process: a thread touches it until `release`."""

    def __init__(
        self, folder: Path, owner: Owner, above: Path | None, on_loss: Callable[[OwnershipLost], None] | None
    ) -> None:
        """
        Args:
            folder: the folder that is owned.
            owner: the owner recorded in the file.
            above: the folder whose owner this one serves, if any.
            on_loss: called once from the thread when it finds the lock lost.
        """
        self.folder = folder
        self.owner = owner
        self._above = above
        self._on_loss = on_loss
        # Touch the file that was created, not whatever has its name now, so that another's lock is never kept alive.
        self._file = os.open(folder / LOCK_FILE, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        self._lost: OwnershipLost | None = None
        self._seen = time.monotonic()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="owner", daemon=True)
        self._thread.start()

    def __getstate__(self) -> dict[str, Any]:
        # Ray pickles everything its callbacks refer to into its own state, which is never read back.
        return {"folder": self.folder, "owner": self.owner}

    def check(self, now: bool = False) -> None:
        """Check that the lock is still held; cheap enough for every step of a loop.

        Args:
            now: check even if the last check is recent.

        Raises:
            OwnershipLost: it is gone, another process has taken it over, or may have while it was unreadable.
        """
        if self._lost is None and (now or time.monotonic() - self._seen > _CHECKED_S):
            self._look()
        if self._lost is not None:
            raise self._lost

    def release(self) -> None:
        """Release the lock, if it is still held."""
        self._done.set()
        self._thread.join()
        os.close(self._file)
        with contextlib.suppress(OSError):  # an unreachable lock becomes stale by itself
            if _token_in(self.folder / LOCK_FILE) == self.owner.token:
                (self.folder / LOCK_FILE).unlink()

    def _beat(self) -> None:
        while not self._done.wait(BEAT_S):
            self._look()
            if self._lost is not None:
                if self._on_loss is not None:
                    self._on_loss(self._lost)
                return

    def _look(self) -> None:
        """Check whether the lock is still held, and touch it if so."""
        try:
            if _token_in(self.folder / LOCK_FILE) != self.owner.token:
                self._lost = OwnershipLost(f"{self.folder} has been taken over by {_find(self.folder) or 'another'}")
            elif self._above is not None and _token_in(self._above / LOCK_FILE) != self.owner.serves:
                self._lost = OwnershipLost(
                    f"the driver of {self._above} that this process serves is no longer its owner"
                )
            else:
                os.utime(self._file)
                self._seen = time.monotonic()
        except FileNotFoundError as error:
            self._lost = OwnershipLost(f"{error.filename} does not exist: moved, removed or taken over")
        except OSError as error:
            # Storage may be unavailable for a moment. After a longer time, others may have taken this owner for dead.
            if time.monotonic() - self._seen > STALE_S / 2:
                self._lost = OwnershipLost(f"cannot keep the lock {self.folder / LOCK_FILE}: {error.strerror}")


def acquire(folder: Path, *, force: bool = False) -> Ownership:
    """Become a folder's owner.

    Args:
        folder: an existing folder.
        force: take it over from any owner.

    Raises:
        StorageError: another owner is alive, or may be.
        StorageFailure: the folder cannot be written.
    """
    owner = _this_process(None)
    _take(folder, owner, force, 0.0)
    return Ownership(folder, owner, None, None)


def acquire_for(
    folder: Path, above: Path, serves: str, on_loss: Callable[[OwnershipLost], None], patience_s: float = 2 * STALE_S
) -> Ownership:
    """Become the owner of a folder on behalf of the owner of its parent experiment, while that owner holds it.

    If a living process holds the folder, wait for it: one that serves an earlier owner notices that and stops.

    Args:
        folder: the folder of a trial.
        above: the folder of its experiment.
        serves: the token of the experiment's owner.
        on_loss: called once, from another thread, when the lock is lost, or the experiment has another owner.
        patience_s: how long to wait [s].

    Raises:
        StorageError: it is still held after that.
        StorageFailure: the folder cannot be written.
        OwnershipLost: the experiment has another owner by now.
    """
    owner = _this_process(serves)
    _take(folder, owner, False, patience_s)
    ownership = Ownership(folder, owner, above, on_loss)
    try:
        ownership.check(now=True)
    except OwnershipLost:
        ownership.release()
        raise
    return ownership


def _this_process(serves: str | None) -> Owner:
    return Owner(
        platform.node(),
        os.getpid(),
        _birth_of(os.getpid()),
        _machine(),
        uuid.uuid4().hex,
        time.strftime("%Y-%m-%d %H:%M:%S"),
        serves,
    )


def _take(folder: Path, owner: Owner, force: bool, patience_s: float) -> None:
    waited = 0.0
    try:
        while not _link(folder, owner):
            lock = _find(folder)
            if lock is None:
                continue  # just released or taken over
            if lock.stale or force:
                _remove(folder, lock)
            elif waited >= patience_s:
                raise StorageError(_refusal(folder, lock))
            else:
                time.sleep(_WAIT_S)
                waited += _WAIT_S  # counted in waits, so that time while this process is stopped does not count
    except OSError as error:
        raise StorageFailure(f"cannot write {folder / LOCK_FILE}: {error.strerror or error}") from error


def has_living_owner(folder: Path, now: float) -> bool | None:
    """Whether a folder's owner is alive, without writing anything: the age of another machine's lock is measured by
    this machine's clock.

    Args:
        folder: the folder.
        now: seconds since the epoch.

    Returns:
        None if there is no lock.
    """
    try:
        owner, touched = _read_lock(folder / LOCK_FILE)
    except OSError:
        return None
    return not _Lock(owner, max(0.0, now - touched)).stale


@contextlib.contextmanager
def owned(folder: Path, force: bool = False) -> Iterator[Ownership]:
    """Own a folder during a block; see `acquire`."""
    ownership = acquire(folder, force=force)
    try:
        yield ownership
    finally:
        ownership.release()


def _refusal(folder: Path, lock: _Lock) -> str:
    wait = f"wait {max(1.0, STALE_S - lock.age_s):.0f} s; "
    if lock.owner is None:
        return f"{folder}: {lock}: if nothing is at work there, {wait}--force takes it over"
    left = "" if lock.owner.alive_here() else f"if it is dead, {wait}"
    return f"{folder} is in use by {lock}: stop that first; {left}--force takes it over"


def _link(folder: Path, owner: Owner) -> bool:
    """Create a lock; False if there already is one."""
    path = folder / LOCK_FILE
    temporary = folder / f".{LOCK_FILE}.{owner.token}.part"
    data = (json.dumps(asdict(owner)) + "\n").encode()
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        try:
            os.link(temporary, path)
        except FileExistsError:
            return False
        except OSError:
            # No hard links here. A process that reads the file before it is written sees a damaged, recent lock.
            try:
                descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
            except FileExistsError:
                return False
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
        return True
    finally:
        temporary.unlink(missing_ok=True)


def _find(folder: Path) -> _Lock | None:
    """The lock in a folder, and how long ago it was touched; None if there is none."""
    probe = folder / f".{LOCK_FILE}.{uuid.uuid4().hex}.part"
    try:
        owner, touched = _read_lock(folder / LOCK_FILE)
    except FileNotFoundError:
        return None
    try:
        probe.touch()
        now = probe.stat().st_mtime
    finally:
        probe.unlink(missing_ok=True)
    return _Lock(owner, max(0.0, now - touched))


def _read_lock(lock: Path) -> tuple[Owner | None, float]:
    """The owner named in a lock, None if the file is damaged; and when it was last touched."""
    try:
        with open_file(lock) as file:  # opening the file makes a network file system refresh it
            return _owner_in(file.read(RECORD.size)), os.fstat(file.fileno()).st_mtime
    except UnusableFile:
        return None, lock.lstat().st_mtime


def _owner_in(data: bytes) -> Owner | None:
    try:
        record = parse_object(data)
        texts = (field(record, name, str) for name in ("host", "birth", "machine", "token", "began"))
        host, birth, machine, token, began = texts
        serves = None if record.get("serves") is None else field(record, "serves", str)
        return Owner(host, field(record, "pid", int), birth, machine, token, began, serves)
    except ValueError:
        return None


def _remove(folder: Path, lock: _Lock) -> None:
    """Remove a lock, if it is still the same."""
    token = None if lock.owner is None else lock.owner.token
    aside = folder / f".{LOCK_FILE}.{uuid.uuid4().hex}.part"
    try:
        if _token_in(folder / LOCK_FILE) != token:
            return  # another process was faster
        os.rename(folder / LOCK_FILE, aside)
    except FileNotFoundError:
        return  # likewise
    if _token_in(aside) != token:
        # Another process took over in between: put its lock back. If a third has linked its own, the second will
        # notice.
        with contextlib.suppress(FileExistsError):
            os.link(aside, folder / LOCK_FILE)
    aside.unlink(missing_ok=True)


def _token_in(lock: Path) -> str | None:
    """The token in a lock; None if the file is damaged."""
    owner, _ = _read_lock(lock)
    return None if owner is None else owner.token


def _birth_of(pid: int) -> str:
    """When a process of this machine was started, in the kernel's ticks; empty if it does not exist or is dead."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if fields[0] == "Z" else fields[19]


def _machine() -> str:
    """An identifier of this boot of this machine, and of this container."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return f"{boot} {os.readlink('/proc/self/ns/pid')}"
