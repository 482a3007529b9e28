"""A checkpoint is one file that vouches for itself."""

import hashlib
import json
import random
from pathlib import Path

import pytest
from fault_campaign.killed import die_within

from msk_ray.errors import CheckpointError, StorageFailure
from msk_ray.experiment.checkpoint_file import (
    read_checkpoint_file,
    read_facts,
    remove_checkpoint_file,
    write_checkpoint_file,
)

PAYLOADS = bytes(range(256)) * 40, b"another\n" * 999


def write_old(path: Path, payload: bytes, **facts: object) -> None:
    """A checkpoint as format 1 had it."""
    path.write_bytes(payload)
    manifest = {"format": 1, "sha256": hashlib.sha256(payload).hexdigest(), "bytes": len(payload), **facts}
    path.with_suffix(".json").write_text(json.dumps(manifest, indent=1))


def test_facts_are_read_without_the_payload(tmp_path: Path) -> None:
    path = tmp_path / "best.pt"
    write_checkpoint_file(path, PAYLOADS[0], {"epoch": 7, "best_score": -1.25})
    facts = read_facts(path)
    assert (facts["epoch"], facts["best_score"], facts["bytes"]) == (7, -1.25, len(PAYLOADS[0]))
    assert facts["sha256"] == hashlib.sha256(PAYLOADS[0]).hexdigest()
    assert read_checkpoint_file(path) == (facts, PAYLOADS[0])
    assert [p.name for p in tmp_path.iterdir()] == ["best.pt"]
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - 1)
    with pytest.raises(CheckpointError, match="is torn"):
        read_facts(path)


def test_every_flipped_bit_of_the_head_and_any_of_the_payload_is_found(tmp_path: Path) -> None:
    path = tmp_path / "best.pt"
    write_checkpoint_file(path, PAYLOADS[0], {"epoch": 7, "best_score": 123.5})
    whole = path.read_bytes()
    head = len(whole) - len(PAYLOADS[0])
    bits = [*range(8 * head), *random.Random(0).sample(range(8 * head, 8 * len(whole)), 200)]
    for bit in bits:
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError) as caught:
            read_checkpoint_file(path)
        assert "\n" not in str(caught.value)


@pytest.mark.long
@pytest.mark.parametrize("old", [False, True])
def test_killed_anywhere_while_it_is_replaced_the_old_or_the_new_one_is_there(tmp_path: Path, old: bool) -> None:
    """Fails with a manifest beside the payload: between their two writes there was neither."""
    path = tmp_path / "best.pt"
    found = set()
    for calls in range(1, 1000):
        if old:
            write_old(path, PAYLOADS[0], epoch=1)
        else:
            write_checkpoint_file(path, PAYLOADS[0], {"epoch": 1})
        killed = die_within(lambda: write_checkpoint_file(path, PAYLOADS[1], {"epoch": 2}), calls)
        facts, payload = read_checkpoint_file(path)
        assert payload == PAYLOADS[facts["epoch"] - 1]
        assert read_facts(path)["epoch"] == facts["epoch"]
        found.add(facts["epoch"])
        if not killed:
            break
    assert not killed
    assert calls > 10
    assert found == {1, 2}
    assert not path.with_suffix(".json").exists()


def test_a_checkpoint_of_format_1_is_read_and_removed(tmp_path: Path) -> None:
    path = tmp_path / "epoch_000003.pt"
    write_old(path, PAYLOADS[1], epoch=3)
    assert read_checkpoint_file(path)[1] == PAYLOADS[1]
    assert read_facts(path)["epoch"] == 3
    remove_checkpoint_file(path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("manifest", [None, b"{", b"\xff\xfe", b"null", b"7", b"[" * 9999, b'{"format": 9}'])
def test_a_damaged_manifest_of_format_1_is_one_line(tmp_path: Path, manifest: bytes | None) -> None:
    path = tmp_path / "best.pt"
    write_old(path, PAYLOADS[0])
    if manifest is None:
        path.with_suffix(".json").unlink()
    else:
        path.with_suffix(".json").write_bytes(manifest)
    for read in (read_facts, read_checkpoint_file):
        with pytest.raises(CheckpointError) as caught:
            read(path)
        assert "\n" not in str(caught.value)


def test_a_newer_format_is_named(tmp_path: Path) -> None:
    path = tmp_path / "best.pt"
    write_checkpoint_file(path, b"x", {})
    path.write_bytes(path.read_bytes().replace(b"checkpoint 2 ", b"checkpoint 3 ", 1))
    with pytest.raises(CheckpointError, match="has checkpoint format 3, this version reads 2 and 1"):
        read_facts(path)


def test_a_folder_that_is_gone_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(StorageFailure, match="cannot write"):
        write_checkpoint_file(tmp_path / "gone" / "best.pt", b"x", {})
    assert not list(tmp_path.iterdir())
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        read_facts(tmp_path / "gone" / "best.pt")
