"""Write files completely or not at all, and check that folders are writable."""

import contextlib
import json
import os
import socket
import time
from pathlib import Path
from typing import Any

from msk_ray.errors import StorageError, StorageFailure

STALE_S = 3600.0
"""Age [s] after which a temporary file counts as abandoned by its writer."""
_PART = ".part"


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
    """Refuse a folder whose path is not text: libraries that write below it would fail once the work has begun."""
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:
        raise StorageError(
            f"cannot write to {path}: its path is not UTF-8; rename it, or choose another folder"
        ) from None


def _cannot_write(path: Path, error: OSError) -> StorageError:
    return StorageError(f"cannot write to {path}: {error.strerror or error}; choose another folder")


def write_bytes(path: Path, payload: bytes) -> None:
    """Write `payload` to `path` so that a reader never sees half a file.

    If the process is killed right afterwards, the file is there; if the machine loses power, it or the one before.

    Raises:
        StorageFailure: the disk is full or the folder not writable; an existing file is left unchanged.
    """
    # Another process, perhaps on another host, may write the same file: each has its own temporary file.
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
    """Remove temporary files left by processes killed while writing: no file takes `STALE_S` to write."""
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
