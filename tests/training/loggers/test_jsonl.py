"""The trial's own record."""

import json
from pathlib import Path

from msk_ray.experiment.metrics import read_metrics
from msk_ray.training.loggers.jsonl import JsonLines


def test_rows_are_on_disk_at_once_and_nan_is_named(tmp_path: Path) -> None:
    log = JsonLines(tmp_path)
    log.write({"epoch": 1, "a": 2.0, "b": float("nan")})
    line = (tmp_path / "metrics.jsonl").read_text().splitlines()[0]
    assert json.loads(line) == {"epoch": 1, "a": 2.0, "b": None, "nonfinite": ["b"]}


def test_rewinding_drops_later_rows(tmp_path: Path) -> None:
    log = JsonLines(tmp_path)
    for epoch in range(5):
        log.write({"epoch": epoch, "a": 0.0})
    log.rewind(2)
    log.write({"epoch": 3, "a": 1.0})
    assert [(r["epoch"], r["a"]) for r in read_metrics(tmp_path / "metrics.jsonl")] == [(0, 0), (1, 0), (2, 0), (3, 1)]


def test_reading_keeps_the_latest_row_of_an_epoch_and_forgives_a_torn_end(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"epoch": 1, "a": 1}\n{"epoch": 2, "a": 2}\n{"epoch": 1, "a": 3}\n{"epoch": 3, "a')
    assert [(r["epoch"], r["a"]) for r in read_metrics(path)] == [(1, 3), (2, 2)]
    path.write_text('{"epo\n{"epoch": 2}\n')
    assert [r["epoch"] for r in read_metrics(path)] == [2]


def test_rewinding_past_a_damaged_line_keeps_the_others_and_names_it(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b'{"epoch": 0, "a": 1}\n\xff\xff\n{"epoch": 2, "a": 3}\n{"epoch": 3, "a": 4}\n{"epoch": 4')
    log = JsonLines(tmp_path)
    (damage,) = log.rewind(2)
    assert str(damage) == f"{path}, line 2: not UTF-8 text: byte 0 is 0xff"
    assert [(r["epoch"], r["a"]) for r in read_metrics(path)] == [(0, 1), (2, 3)]
    assert path.read_bytes().count(b"\n") == 2


def test_rewinding_to_before_the_first_row_drops_a_torn_one(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"epoch": 0, "a": 1}\n{"epoch": 1')
    log = JsonLines(tmp_path)
    log.rewind(-1)
    log.write({"epoch": 0, "a": 2.0})
    assert [(r["epoch"], r["a"]) for r in read_metrics(path)] == [(0, 2)]
