"""Checkpoints that are either whole or not there.

A checkpoint is `<name>.pt` and, written after it, `<name>.json` with its SHA-256: a file without a matching manifest
is torn. Both are written to a temporary name, flushed to disk and renamed.
"""

import hashlib
import io
import json
import re
from pathlib import Path
from typing import Any

import torch

from msk_ray.errors import CheckpointError
from msk_ray.files import write_bytes

FORMAT = 1
_EPOCH_NAME = re.compile(r"epoch_(\d+)\.pt")
_POLICY_NAME = re.compile(r"policy_(\d+)\.pt")


def write_checkpoint(path: Path, state: dict[str, Any], facts: dict[str, Any]) -> Path:
    """Write `state` to `path` and its manifest, with `facts` such as the epoch, beside it."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    payload = buffer.getvalue()
    # A manifest left from before would vouch for the wrong payload if a crash came between the two writes.
    manifest_path(path).unlink(missing_ok=True)
    write_bytes(path, payload)
    manifest = {"format": FORMAT, "sha256": hashlib.sha256(payload).hexdigest(), "bytes": len(payload), **facts}
    write_bytes(manifest_path(path), json.dumps(manifest, indent=1).encode())
    return path


def manifest_path(path: Path) -> Path:
    """Where the manifest of a checkpoint lies."""
    return path.with_suffix(".json")


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of the checkpoint at `path`: format, sha256, bytes, and facts such as the epoch.

    Raises:
        CheckpointError: it is missing, unreadable, or of another format.
    """
    try:
        manifest = json.loads(manifest_path(path).read_text())
    except FileNotFoundError as error:
        raise CheckpointError(f"no such checkpoint: {error.filename}") from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"cannot read checkpoint {path}: {error}") from error
    found = manifest.get("format") if isinstance(manifest, dict) else None
    if found != FORMAT:
        raise CheckpointError(f"{path} has checkpoint format {found}, this version reads {FORMAT}")
    facts: dict[str, Any] = manifest
    return facts


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The state in a checkpoint, on CPU.

    Raises:
        CheckpointError: it is missing, torn, or of another format.
    """
    try:
        payload = path.read_bytes()
    except FileNotFoundError as error:
        raise CheckpointError(f"no such checkpoint: {error.filename}") from None
    except OSError as error:
        raise CheckpointError(f"cannot read checkpoint {path}: {error}") from error
    manifest = read_manifest(path)
    if hashlib.sha256(payload).hexdigest() != manifest.get("sha256"):
        raise CheckpointError(
            f"{path} is torn: {len(payload)} bytes of {manifest.get('bytes')}, checksum differs; use an older one of "
            f"{path.parent}"
        )
    state: dict[str, Any] = torch.load(io.BytesIO(payload), map_location="cpu", weights_only=True)
    return state


def epoch_checkpoints(folder: Path) -> list[Path]:
    """Numbered checkpoints of a folder, newest first."""
    return [path for _, path in reversed(_numbered(folder, _EPOCH_NAME))]


def milestones(folder: Path) -> list[tuple[int, Path]]:
    """The policies kept along a trial's way, as (epoch, path), oldest first."""
    return _numbered(folder, _POLICY_NAME)


def milestone_path(folder: Path, epoch: int) -> Path:
    """Where the policy of an epoch is kept."""
    return folder / f"policy_{epoch:06d}.pt"


def _numbered(folder: Path, name: re.Pattern[str]) -> list[tuple[int, Path]]:
    if not folder.is_dir():
        return []
    return sorted((int(m.group(1)), p) for p in folder.iterdir() if (m := name.fullmatch(p.name)))


def newest_valid_checkpoint(folder: Path) -> tuple[Path | None, list[str]]:
    """The newest numbered checkpoint that reads whole, and a line on each newer one that does not."""
    faults = []
    for path in epoch_checkpoints(folder):
        try:
            read_checkpoint(path)
        except CheckpointError as error:
            faults.append(str(error))
        else:
            return path, faults
    return None, faults


def prune_checkpoints(folder: Path, keep: int) -> None:
    """Delete all but the `keep` newest numbered checkpoints."""
    for path in epoch_checkpoints(folder)[keep:]:
        path.unlink()
        manifest_path(path).unlink(missing_ok=True)
