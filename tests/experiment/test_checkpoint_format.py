"""A checkpoint is one file that vouches for itself."""

import hashlib
import random
from pathlib import Path

import pytest
from fault_campaign.killed import die_within

from msk_ray.errors import CheckpointError, StorageFailure
from msk_ray.experiment.checkpoint_format import (
    read_checkpoint_file,
    read_facts,
    write_checkpoint_file,
)

PAYLOADS = bytes(range(256)) * 40, b"another\n" * 999


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
def test_killed_anywhere_while_it_is_replaced_the_old_or_the_new_one_is_there(tmp_path: Path) -> None:
    path = tmp_path / "best.pt"
    kept = set()
    for calls in range(1, 1000):
        write_checkpoint_file(path, PAYLOADS[0], {"epoch": 1})
        killed = die_within(lambda: write_checkpoint_file(path, PAYLOADS[1], {"epoch": 2}), calls)
        facts, payload = read_checkpoint_file(path)
        assert payload == PAYLOADS[facts["epoch"] - 1]
        assert read_facts(path)["epoch"] == facts["epoch"]
        kept.add(facts["epoch"])
        if not killed:
            break
    assert not killed
    assert calls > 10
    assert kept == {1, 2}


def test_what_has_no_head_is_torn(tmp_path: Path) -> None:
    path = tmp_path / "best.pt"
    path.write_bytes(PAYLOADS[0])
    for read in (read_facts, read_checkpoint_file):
        with pytest.raises(CheckpointError, match="is torn: it has no head"):
            read(path)


def test_a_newer_format_is_named(tmp_path: Path) -> None:
    path = tmp_path / "best.pt"
    write_checkpoint_file(path, b"x", {})
    path.write_bytes(path.read_bytes().replace(b"checkpoint 2 ", b"checkpoint 3 ", 1))
    with pytest.raises(CheckpointError, match="has checkpoint format 3, this version reads 2"):
        read_facts(path)


def test_a_folder_that_is_gone_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(StorageFailure, match="cannot write"):
        write_checkpoint_file(tmp_path / "gone" / "best.pt", b"x", {})
    assert not list(tmp_path.iterdir())
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        read_facts(tmp_path / "gone" / "best.pt")
