"""The checkpoint format: one file with checksums inside, always replaced as a whole.

    msk_ray checkpoint 2 <SHA-256 of the next line>\\n
    {"bytes": ..., "sha256": <of the payload>, "epoch": ..., ...}\\n
    payload

The first two lines are the head: metadata such as the epoch and the score can be read without the payload. Every bit of
the file is verified: by the first line, the digest in it, or the digest in the second.

Which checkpoint of a trial is the newest usable one: `training/checkpoint.py`.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from msk_ray.errors import CheckpointError
from msk_ray.experiment.damage import LINE, cut, field, parse_object
from msk_ray.files import UnusableFile, open_file, write_bytes

FORMAT = 2
_NAME = b"msk_ray checkpoint "
_DIGEST = 64
"""Hexadecimal digits of a SHA-256."""
_HEAD_LIMIT = 1 << 16
"""Maximum length of a head [bytes]."""
_LIMIT = 1 << 36
"""Maximum size of a checkpoint [bytes]; two million ants need a hundredth of it."""


def write_checkpoint_file(path: Path, payload: bytes, facts: Mapping[str, Any]) -> None:
    """Write a checkpoint to `path` atomically: after a crash, either the complete old or the complete new one is there.

    Args:
        payload: content of the checkpoint.
        facts: plain data that can be read without the payload, such as epoch and score; no NaN.

    Raises:
        StorageFailure: the disk is full or gone; an existing checkpoint is left unchanged.
    """
    facts = {**facts, "format": FORMAT, "bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()}
    line = json.dumps(facts, allow_nan=False).encode()
    assert len(line) < _HEAD_LIMIT // 2
    first = _NAME + b"%d " % FORMAT + hashlib.sha256(line).hexdigest().encode()
    write_bytes(path, b"\n".join([first, line, payload]))


def read_facts(path: Path) -> dict[str, Any]:
    """The facts of a checkpoint: format, bytes and sha256 of its payload, and the facts given to `write`.

    The payload is not read, but the length of the file is checked.

    Raises:
        CheckpointError: it is missing, incomplete, of another format, or no regular file.
    """
    with _opened(path) as file:
        return _read_head(path, file)[0]


def read_checkpoint_file(path: Path) -> tuple[dict[str, Any], bytes]:
    """Facts and payload of a checkpoint.

    Raises:
        CheckpointError: it is missing, incomplete, of another format, no regular file, or larger than the memory.
    """
    with _opened(path) as file:
        facts, begin = _read_head(path, file)
        file.seek(begin)
        try:
            payload = file.read(facts["bytes"])
        except MemoryError:
            raise CheckpointError(f"{path} has {facts['bytes']} bytes, more than fit into memory") from None
    if hashlib.sha256(payload).hexdigest() != facts["sha256"]:
        raise _torn(path, len(payload), facts)
    return facts, payload


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    try:
        with open_file(path, follow=True) as file:
            yield file
    except UnusableFile as error:
        raise CheckpointError(f"cannot read checkpoint {path}: {error}") from None
    except OSError as error:
        raise _unreadable(path, error) from None


def _read_head(path: Path, file: BinaryIO) -> tuple[dict[str, Any], int]:
    """The checked facts in the head of an open checkpoint, and where its payload begins."""
    facts, begin = _find_head(path, file)
    try:
        size = field(facts, "bytes", int)
        field(facts, "sha256", str)
        if "epoch" in facts:
            field(facts, "epoch", int)
    except ValueError as error:
        raise CheckpointError(f"{path} is no checkpoint of a trial: {error}") from None
    size_on_disk = os.fstat(file.fileno()).st_size - begin
    if size_on_disk != size:
        raise _torn(path, size_on_disk, facts)
    if size > _LIMIT:
        raise CheckpointError(f"{path} has {size} bytes, more than any checkpoint")
    return facts, begin


def _find_head(path: Path, file: BinaryIO) -> tuple[dict[str, Any], int]:
    head = file.read(_HEAD_LIMIT)
    if not head.startswith(_NAME):
        raise CheckpointError(f"{path} is torn: it has no head; use an older one of {path.parent}")
    first, _, rest = head.partition(b"\n")
    line, newline, _ = rest.partition(b"\n")
    number, _, digest = first[len(_NAME) :].partition(b" ")
    if number != b"%d" % FORMAT and number.isdigit():
        raise CheckpointError(f"{path} has checkpoint format {number.decode()}, this version reads {FORMAT}")
    whole = len(digest) == _DIGEST and newline and hashlib.sha256(line).hexdigest().encode() == digest
    if number != b"%d" % FORMAT or not whole:
        raise CheckpointError(f"{path} is torn: the checksum of its head differs; use an older one of {path.parent}")
    try:
        return parse_object(line, LINE), len(first) + len(line) + 2
    except ValueError as error:
        raise CheckpointError(f"{path} is no checkpoint of a trial: its head is {cut(error)}") from None


def _torn(path: Path, size: int, facts: Mapping[str, Any]) -> CheckpointError:
    return CheckpointError(
        f"{path} is torn: {size} bytes of {facts.get('bytes')!r:.40}, checksum differs; use an older one of "
        f"{path.parent}"
    )


def _unreadable(path: Path, error: OSError) -> CheckpointError:
    if isinstance(error, FileNotFoundError):
        return CheckpointError(f"no such checkpoint: {path}")
    return CheckpointError(f"cannot read checkpoint {path}: {error.strerror or error}")
