"""Checkpoints are whole or refused."""

import io
import pickle
from pathlib import Path

import pytest
import torch

from msk_ray.errors import CheckpointError
from msk_ray.experiment.checkpoint_format import write_checkpoint_file
from msk_ray.training.checkpoint import (
    epoch_checkpoints,
    newest_valid_checkpoint,
    prune_checkpoints,
    read_checkpoint,
    write_checkpoint,
)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    path = write_checkpoint(tmp_path / "epoch_000001.pt", {"x": torch.arange(3), "n": 7}, {"epoch": 1})
    state = read_checkpoint(path)
    assert torch.equal(state["x"], torch.arange(3))
    assert state["n"] == 7


@pytest.mark.parametrize("damage", ["truncate", "flip", "zero"])
def test_damage_is_found(tmp_path: Path, damage: str) -> None:
    path = write_checkpoint(tmp_path / "epoch_000001.pt", {"x": torch.arange(1000)}, {})
    payload = bytearray(path.read_bytes())
    match damage:
        case "truncate":
            path.write_bytes(payload[: len(payload) // 2])
        case "flip":
            payload[len(payload) // 2] ^= 1
            path.write_bytes(payload)
        case "zero":
            path.write_bytes(bytes(len(payload)))
    with pytest.raises(CheckpointError) as caught:
        read_checkpoint(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "payload", [b"", b"no pickle", pickle.dumps({"epoch": object}, 2), b"\x80\x02}q\x00."[:3], None]
)
def test_a_checkpoint_with_the_right_checksum_that_holds_no_state_is_passed_over(
    tmp_path: Path, payload: bytes | None
) -> None:
    write_checkpoint(tmp_path / "epoch_000005.pt", {"epoch": 5}, {})
    if payload is None:
        buffer = io.BytesIO()
        torch.save([1, 2], buffer)
        payload = buffer.getvalue()
    write_checkpoint_file(tmp_path / "epoch_000010.pt", payload, {"epoch": 10})
    path, faults = newest_valid_checkpoint(tmp_path)
    assert path == tmp_path / "epoch_000005.pt"
    assert len(faults) == 1
    assert "epoch_000010.pt holds no state of a trial" in faults[0]
    assert "\n" not in faults[0]


def test_the_newest_whole_checkpoint_is_found_past_a_torn_one(tmp_path: Path) -> None:
    for epoch in (5, 10, 100):
        write_checkpoint(tmp_path / f"epoch_{epoch:06d}.pt", {"epoch": epoch}, {})
    (tmp_path / "epoch_000100.pt").write_bytes(b"torn")
    path, faults = newest_valid_checkpoint(tmp_path)
    assert path == tmp_path / "epoch_000010.pt"
    assert len(faults) == 1
    assert "epoch_000100.pt is torn" in faults[0]
    assert newest_valid_checkpoint(tmp_path / "nowhere") == (None, [])


def test_only_the_newest_are_kept(tmp_path: Path) -> None:
    for epoch in (1, 2, 3, 10):
        write_checkpoint(tmp_path / f"epoch_{epoch:06d}.pt", {}, {})
    write_checkpoint(tmp_path / "best.pt", {}, {})
    prune_checkpoints(tmp_path, 2)
    assert [p.name for p in epoch_checkpoints(tmp_path)] == ["epoch_000010.pt", "epoch_000003.pt"]
    assert len(list(tmp_path.iterdir())) == 3
