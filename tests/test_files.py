"""Files that are whole or not there."""

import os
import time
from pathlib import Path

import pytest

from msk_ray.errors import StorageError
from msk_ray.files import STALE_S, remove_stale, write_bytes


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    write_bytes(path, b"old")

    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("msk_ray.files.os.fsync", full_disk)
    with pytest.raises(StorageError, match="No space left on device"):
        write_bytes(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_what_a_killed_writer_left_goes_and_what_is_being_written_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Path] = []
    monkeypatch.setattr("msk_ray.files.os.fsync", lambda descriptor: seen.extend(tmp_path.iterdir()))
    write_bytes(tmp_path / "best.pt", b"whole")
    (temporary,) = seen
    killed, going = tmp_path / temporary.name.replace("best", "old"), tmp_path / temporary.name.replace("best", "new")
    for path in (killed, going):
        path.write_bytes(b"half")
    then = time.time() - STALE_S - 1.0
    os.utime(killed, (then, then))
    os.utime(tmp_path / "best.pt", (then, then))
    remove_stale(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"best.pt", going.name}
