"""A trial's checkpoints: writing, reading, and choosing the newest usable one.

Each is a PyTorch state in a file with checksums (`experiment/checkpoint_format.py`), complete or absent.
"""

import io
import re
from pathlib import Path
from typing import Any

import torch

from msk_ray.errors import CheckpointError
from msk_ray.experiment.checkpoint_format import read_checkpoint_file, write_checkpoint_file
from msk_ray.networks import parameter_hash

_EPOCH_NAME = re.compile(r"epoch_(\d+)\.pt")
_POLICY_NAME = re.compile(r"policy_(\d+)\.pt")
_UNSCORED_NAME = re.compile(r"unscored_(\d+)\.pt")


def write_checkpoint(path: Path, state: dict[str, Any], facts: dict[str, Any]) -> Path:
    """Write `state` to `path`, with `facts` such as the epoch that can be read without it; an existing file is replaced
    as a whole. The digest of all modules of a trial, `parameters`, is one of the facts.

    Raises:
        StorageFailure: the disk is full or gone; an existing file is left unchanged.
    """
    if "algorithm" in state:
        facts = facts | {"parameters": parameter_hash(state["algorithm"]["modules"])}
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_checkpoint_file(path, buffer.getvalue(), facts)
    return path


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The state in a checkpoint, on CPU.

    Raises:
        CheckpointError: it is missing, torn, of another format, or holds no state.
    """
    return load_checkpoint(path)[1]


def load_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The facts and the state in a checkpoint, on CPU.

    Raises:
        CheckpointError: as `read_checkpoint`.
    """
    facts, payload = read_checkpoint_file(path)
    try:
        state = torch.load(io.BytesIO(payload), map_location="cpu", weights_only=True)
    except Exception as error:  # any type: damaged bytes make the unpickler raise anything
        why = str(error).strip().splitlines()[:1] or [""]
        raise CheckpointError(
            f"{path} holds no state of a trial ({type(error).__name__}: {why[0]:.120}); use an older one of "
            f"{path.parent}"
        ) from error
    if not isinstance(state, dict):
        raise CheckpointError(
            f"{path} holds no state of a trial (a {type(state).__name__}); use an older one of {path.parent}"
        )
    if "algorithm" not in state and "shac" in state:
        # The format of versions that had SHAC only.
        state["algorithm"] = state.pop("shac")
    # Older checkpoints have no digest.
    if "parameters" in facts and parameter_hash(state["algorithm"]["modules"]) != facts["parameters"]:
        raise CheckpointError(
            f"{path} is damaged: its weights do not match their hash {facts['parameters']!r:.40}; use an older "
            f"one of {path.parent}"
        )
    return facts, state


def epoch_checkpoints(folder: Path) -> list[Path]:
    """Numbered checkpoints of a folder, newest first."""
    return [path for _, path in reversed(_numbered(folder, _EPOCH_NAME))]


def milestones(folder: Path) -> list[tuple[int, Path]]:
    """Policies saved during a trial, as (epoch, path), oldest first."""
    return _numbered(folder, _POLICY_NAME)


def milestone_path(folder: Path, epoch: int) -> Path:
    """Path of the policy saved at an epoch."""
    return folder / f"policy_{epoch:06d}.pt"


def unscored_checkpoints(folder: Path) -> list[tuple[int, Path]]:
    """Trial states that still have to be scored, as (epoch, path), oldest first."""
    return _numbered(folder, _UNSCORED_NAME)


def unscored_path(folder: Path, epoch: int) -> Path:
    """Path of an epoch's state that still has to be scored."""
    return folder / f"unscored_{epoch:06d}.pt"


def _numbered(folder: Path, name: re.Pattern[str]) -> list[tuple[int, Path]]:
    if not folder.is_dir():
        return []
    return sorted((int(m.group(1)), p) for p in folder.iterdir() if (m := name.fullmatch(p.name)))


def newest_valid_checkpoint(folder: Path) -> tuple[Path | None, list[str]]:
    """The newest numbered checkpoint that is intact, and a line for each newer one that is not."""
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
