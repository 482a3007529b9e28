"""Reading regular files within limits, writing atomically, and checking that folders are writable.

A folder of experiments may come from anywhere. Instead of a file, it may contain a pipe or device, which would block a
reader or fill its memory, or a link to a private file.
"""

import contextlib
import errno
import json
import os
import socket
import stat
import time
from pathlib import Path
from typing import Any, BinaryIO

from msk_ray.errors import StorageError, StorageFailure

STALE_S = 3600.0
"""Age after which a temporary file counts as abandoned [s]."""
_PART = ".part"
_TAIL = 1 << 16
"""Number of bytes at the end of a file in which to look for its last lines."""
_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFSOCK: "a socket",
}


class UnusableFile(ValueError):
    """A path is not a regular file, or the file is too large. The message says which."""


def open_file(path: Path, *, follow: bool = False) -> BinaryIO:
    """Open a regular file for reading; never blocks on, or reads, anything else.

    Args:
        follow: follow a symbolic link, for a file named by the user.

    Raises:
        UnusableFile: it is not a regular file.
        OSError: it does not exist, or cannot be opened.
    """
    return os.fdopen(_open(path, os.O_RDONLY, follow), "rb")


def read_file(path: Path, limit: int) -> bytes:
    """The content of a regular file.

    Args:
        limit: maximum size [B].

    Raises:
        UnusableFile: it is not a regular file, or larger.
        OSError: it does not exist, or cannot be read.
    """
    with open_file(path) as file:
        if os.fstat(file.fileno()).st_size <= limit:
            data = file.read(limit + 1)  # it may be growing
            if len(data) <= limit:
                return data
    raise UnusableFile(f"larger than {_in_words(limit)}")


def last_lines(path: Path, count: int) -> list[str]:
    """The last lines of a text file of any size; bytes that are not UTF-8 are replaced.

    Raises:
        UnusableFile: it is no regular file.
        OSError: it does not exist, or cannot be read.
    """
    with open_file(path) as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL))
        return file.read(_TAIL).decode("utf-8", errors="replace").splitlines()[-count:]


def append_text(path: Path, text: str, *, sync: bool = False) -> None:
    """Append text to a regular file; creates it if necessary.

    Args:
        sync: return only once the text would survive a power loss.

    Raises:
        StorageFailure: the disk is full, or the path is not a regular file.
    """
    try:
        with os.fdopen(_open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, False), "ab") as file:
            file.write(text.encode())
            file.flush()
            if sync:
                os.fsync(file.fileno())
    except OSError as error:
        raise StorageFailure(f"cannot write {path}: {error.strerror or error}") from error
    except UnusableFile as error:
        raise StorageFailure(f"cannot write {path}: {error}") from error


def _open(path: Path, flags: int, follow: bool) -> int:
    """A descriptor of a regular file. Opening does not block, not even on a pipe."""
    flags |= os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)
    try:
        descriptor = os.open(path, flags, 0o644)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO, errno.ENODEV, errno.EISDIR):
            _check_regular(os.lstat(path).st_mode)
        raise
    try:
        _check_regular(os.fstat(descriptor).st_mode)
    except UnusableFile:
        os.close(descriptor)
        raise
    return descriptor


def _check_regular(mode: int) -> None:
    if not stat.S_ISREG(mode):
        raise UnusableFile(f"{_KINDS.get(stat.S_IFMT(mode), 'something')} instead of a regular file")


def _in_words(size: int) -> str:
    return f"{size >> 20} MiB" if size >= 1 << 20 else f"{size} bytes"


def make_folder(path: Path) -> None:
    """Create a folder and its parents if they do not exist, and check that files can be written to it.

    Raises:
        StorageError: it cannot be created or written to, or its path is not UTF-8.
    """
    _check_text(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _cannot_write(path, error) from error
    check_writable(path)


def check_writable(path: Path) -> None:
    """Check a folder by writing a file: permissions alone do not reveal full disks or read-only mounts.

    Raises:
        StorageError: the folder cannot be written to or does not exist, or its path is not UTF-8.
    """
    _check_text(path)
    probe = path / f".probe.{socket.gethostname()}.{os.getpid()}"
    try:
        probe.write_bytes(b"0" * 4096)
        probe.unlink()
    except OSError as error:
        raise _cannot_write(path, error) from error


def _check_text(path: Path) -> None:
    """Raise if a folder's path is not UTF-8: libraries that write to it would fail in the middle of the work."""
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:
        raise StorageError(
            f"cannot write to {path}: its path is not UTF-8; rename it, or choose another folder"
        ) from None


def _cannot_write(path: Path, error: OSError) -> StorageError:
    return StorageError(f"cannot write to {path}: {error.strerror or error}; choose another folder")


def write_bytes(path: Path, payload: bytes) -> None:
    """Write `payload` to `path` atomically: readers never see a partial file.

    After a kill of the process, the new file is there; after a power loss, the new or the old one.

    Raises:
        StorageFailure: the disk is full or the folder not writable; an existing file is left unchanged.
    """
    # Another process, perhaps on another host, may write the same file, so the temporary name is unique.
    temporary = path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}{_PART}")
    try:
        with temporary.open("wb") as file:
            file.write(payload)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise StorageFailure(f"cannot write {path}: {error.strerror or error}") from error


def remove_stale(folder: Path) -> None:
    """Remove temporary files of processes killed while writing, older than `STALE_S`."""
    for path in folder.glob(f".*{_PART}"):
        with contextlib.suppress(FileNotFoundError):  # its writer, or another process calling this, was faster
            if time.time() - path.stat().st_mtime > STALE_S:
                path.unlink()


def write_text(path: Path, text: str) -> None:
    """Write text as `write_bytes` does."""
    write_bytes(path, text.encode())


def write_json(path: Path, data: Any) -> None:
    """Write plain data as `write_bytes` does."""
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")
