"""Files that are whole or not there at all, and folders that take them."""

import contextlib
import json
import os
import socket
import time
from pathlib import Path
from typing import Any

from msk_ray.errors import StorageError, StorageFailure

STALE_S = 3600.0
"""Age after which a temporary file has lost its writer."""
_PART = ".part"


def make_folder(path: Path) -> None:
    """Make a folder that files can be written to, with those above it, or find it there.

    Raises:
        StorageError: it did not work.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _cannot_write(path, error) from error
    check_writable(path)


def check_writable(path: Path) -> None:
    """Write a file into a folder: permissions alone do not tell (full disks, read-only mounts).

    Raises:
        StorageError: it did not work, or there is no such folder.
    """
    probe = path / f".probe.{socket.gethostname()}.{os.getpid()}"
    try:
        probe.write_bytes(b"0" * 4096)
        probe.unlink()
    except OSError as error:
        raise _cannot_write(path, error) from error


def _cannot_write(path: Path, error: OSError) -> StorageError:
    return StorageError(f"cannot write to {path}: {error.strerror or error}; choose another folder")


def write_bytes(path: Path, payload: bytes) -> None:
    """Put `payload` at `path` so that a reader never sees half a file, and the file survives a crash right after.

    Raises:
        StorageFailure: the disk is full or the folder not writable; what was there before is untouched.
    """
    # Another process, perhaps of another host, may write the same file: each has its own temporary.
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
    """Remove temporaries that processes killed while writing have left here: none takes `STALE_S` to write."""
    for path in folder.glob(f".*{_PART}"):
        with contextlib.suppress(FileNotFoundError):  # its writer, or another process here, was faster
            if time.time() - path.stat().st_mtime > STALE_S:
                path.unlink()


def write_text(path: Path, text: str) -> None:
    """Write text as `write_bytes` does."""
    write_bytes(path, text.encode())


def write_json(path: Path, data: Any) -> None:
    """Write plain data as `write_bytes` does."""
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")
