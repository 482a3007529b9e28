"""The format of a checkpoint: one file that contains its own checksums and is always replaced as a whole.

    msk_ray checkpoint 2 <SHA-256 of the next line>\\n
    {"bytes": ..., "sha256": <of the payload>, "epoch": ..., ...}\\n
    payload

The first two lines are the head: metadata such as the epoch and the score can be read without the payload. Every bit of
the file is verified: by the first line, the digest in it, or the digest in the second.

Checkpoints of format 1 are a payload and a separate `<name>.json` with its SHA-256 and the metadata; they can still be
read.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from msk_ray.errors import CheckpointError
from msk_ray.files import write_bytes

FORMAT = 2
_NAME = b"msk_ray checkpoint "
_DIGEST = 64
"""Hexadecimal digits of a SHA-256."""
_HEAD_LIMIT = 1 << 16
"""Maximum length of a head [bytes]."""


def write_checkpoint_file(path: Path, payload: bytes, facts: Mapping[str, Any]) -> None:
    """Write a checkpoint to `path`. If the process dies at any moment, the complete old or the complete new one is
    there.

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
    # The manifest of an earlier checkpoint of format 1; it does not apply to the new file.
    _old_manifest(path).unlink(missing_ok=True)


def remove_checkpoint_file(path: Path) -> None:
    """Delete a checkpoint of any format."""
    path.unlink()
    _old_manifest(path).unlink(missing_ok=True)


def read_facts(path: Path) -> dict[str, Any]:
    """The facts of a checkpoint: format, bytes, sha256 of its payload, and those given when it was written.

    The payload is not read, but the length of the file is checked.

    Raises:
        CheckpointError: it is missing, incomplete, or of another format.
    """
    try:
        with path.open("rb") as file:
            facts, begin = _read_head(path, file)
            size = os.fstat(file.fileno()).st_size
    except OSError as error:
        raise _unreadable(path, error) from None
    if size - begin != facts.get("bytes"):
        raise _torn(path, size - begin, facts)
    return facts


def read_checkpoint_file(path: Path) -> tuple[dict[str, Any], bytes]:
    """Facts and payload of a checkpoint.

    Raises:
        CheckpointError: it is missing, incomplete, or of another format.
    """
    try:
        with path.open("rb") as file:
            facts, begin = _read_head(path, file)
            file.seek(begin)
            payload = file.read()
    except OSError as error:
        raise _unreadable(path, error) from None
    if hashlib.sha256(payload).hexdigest() != facts.get("sha256"):
        raise _torn(path, len(payload), facts)
    return facts, payload


def _read_head(path: Path, file: BinaryIO) -> tuple[dict[str, Any], int]:
    """The facts in the head of an open checkpoint, and where its payload begins."""
    head = file.read(_HEAD_LIMIT)
    if not head.startswith(_NAME):
        return _read_old_manifest(path), 0
    first, _, rest = head.partition(b"\n")
    line, newline, _ = rest.partition(b"\n")
    number, _, digest = first[len(_NAME) :].partition(b" ")
    if number != b"%d" % FORMAT and number.isdigit():
        raise CheckpointError(f"{path} has checkpoint format {number.decode()}, this version reads {FORMAT} and 1")
    whole = len(digest) == _DIGEST and newline and hashlib.sha256(line).hexdigest().encode() == digest
    if number != b"%d" % FORMAT or not whole:
        raise CheckpointError(f"{path} is torn: the checksum of its head differs; use an older one of {path.parent}")
    facts: dict[str, Any] = json.loads(line)
    return facts, len(first) + len(line) + 2


def _old_manifest(path: Path) -> Path:
    """Path of the manifest of a checkpoint of format 1."""
    return path.with_suffix(".json")


def _read_old_manifest(path: Path) -> dict[str, Any]:
    try:
        facts = json.loads(_old_manifest(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CheckpointError(
            f"{path} is torn: it has neither a head nor a manifest; use an older one of {path.parent}"
        ) from None
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"cannot read {_old_manifest(path)}: {error}") from None
    found = facts.get("format") if isinstance(facts, dict) else None
    if found != 1:
        raise CheckpointError(f"{_old_manifest(path)} has checkpoint format {found!r:.40}, this version reads 1 there")
    manifest: dict[str, Any] = facts
    return manifest


def _torn(path: Path, found: int, facts: Mapping[str, Any]) -> CheckpointError:
    return CheckpointError(
        f"{path} is torn: {found} bytes of {facts.get('bytes')!r:.40}, checksum differs; use an older one of "
        f"{path.parent}"
    )


def _unreadable(path: Path, error: OSError) -> CheckpointError:
    if isinstance(error, FileNotFoundError):
        return CheckpointError(f"no such checkpoint: {path}")
    return CheckpointError(f"cannot read checkpoint {path}: {error.strerror or error}")
