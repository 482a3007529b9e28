"""Whatever is done to a file, what is whole in it stays, and what is not is named."""

import contextlib
import errno
import json
import random
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msk_ray.config import dump_yaml
from msk_ray.errors import MskRayError, StorageFailure
from msk_ray.experiment import damage
from msk_ray.experiment.attempts import Attempt, WorldReduction, load_attempt
from msk_ray.experiment.damage import DamagedFile, read_object
from msk_ray.experiment.evaluation_log import EvaluationLog, LogEntry
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import load_metrics
from msk_ray.experiment.outcomes import Ending, Outcome, load_ending, read_ending, write_ending
from msk_ray.experiment.records import ExperimentReader, read_records
from msk_ray.experiment.results_table import summary, table_document
from msk_ray.experiment.snapshot import State, read_trial
from msk_ray.report.reading import read_experiment
from msk_ray.sweep import opening
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials

ODD_LINES = [
    b"", b"null", b"7", b"true", b'"text"', b"[]", b"{}", b"\xff\xfe{}", b"\x00" * 64, b'{"epoch": 1', b"[" * 5000,
    b'{"epoch": 1e400}', b'{"epoch": 10000000000000}', b'{"epoch": -1}', b'{"epoch": null}', b'{"epoch": true}',
    b'{"epoch": 1.5}', b'{"epoch": "1"}', b'{"epoch": NaN}', b'{"epoch": 1, "eval/score": "high"}',
    b'{"epoch": 1, "eval/score": 1.0}', b'{"epoch": 1, "a": {}}', b'{"epoch": 1, "nonfinite": 3}',
    b'{"epoch": 1, "a": 1' + b"0" * 400 + b"}", b'{"epoch": ' + b"9" * 5000 + b"}",
]  # fmt: skip
"""Lines of which none is a row of metrics or a report, nor an ending."""

anything: st.SearchStrategy[bytes] = st.one_of(
    st.binary(max_size=200),
    st.sampled_from(ODD_LINES),
    st.recursive(
        st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8)),
        lambda inner: st.one_of(
            st.lists(inner, max_size=3),
            st.dictionaries(
                st.sampled_from(["epoch", "seconds", "eval/score", "outcome", "why", "trials", "format", "asked"]),
                inner,
            ),
        ),
        max_leaves=8,
    ).map(lambda value: json.dumps(value).encode()),
)


def row(epoch: int) -> dict[str, Any]:
    return {"epoch": epoch, "env_steps": 10 * epoch, "seconds": 0.5 * epoch, "eval/score": 2.0 * epoch}


@pytest.mark.parametrize("odd", ODD_LINES, ids=[line[:24].decode("latin1") for line in ODD_LINES])
def test_an_odd_line_is_named_and_hides_no_other(odd: bytes, tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    rows = [json.dumps(row(epoch)).encode() for epoch in range(4)]
    path.write_bytes(b"\n".join([rows[0], rows[1], odd, rows[2], rows[3], b""]))
    metrics = load_metrics(path)
    assert [r["epoch"] for r in metrics.rows] == [0, 1, 2, 3]
    (named,) = metrics.damages
    assert (named.path, named.line) == (path, 3)
    assert str(named).startswith(f"{path}, line 3: ")
    assert "\n" not in str(named)
    assert len(named.what) <= 100


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 6), anything), max_size=5), st.integers(0, 30))
def test_lines_among_which_others_are_put_are_all_found(others: list[tuple[int, bytes]], torn: int) -> None:
    reports = [LogEntry("a", epoch, 10 * epoch, 0.5, 1.0 * epoch, False) for epoch in range(6)]
    lines = [json.dumps(vars(report)).encode() for report in reports]
    for place, other in sorted(others, key=lambda item: -item[0]):
        lines.insert(place, other)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "reports.jsonl"
        path.write_bytes(b"\n".join(lines) + b"\n" + b'{"trial": "a", "epoch": 9, "env'[:torn])
        entries, damages = EvaluationLog(path).read()
        again = EvaluationLog(path).read()
    assert [report for report in entries if report in reports] == reports
    assert len(entries) + len(damages) == sum(len(line.split(b"\n")) for line in lines)
    assert again == (entries, damages)


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(anything)
def test_a_file_of_anything_is_read_or_refused_in_one_line(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file in ("outcome.json", "halved.json", "device.json", "metrics.jsonl"):
            (folder / file).write_bytes(data)
        for load in (load_ending, load_attempt):
            with contextlib.suppress(DamagedFile):
                load(folder)
        read_ending(folder)
        seen = read_trial(folder)
        assert seen.folder == folder
        for damage_seen in seen.damages:
            assert "\n" not in str(damage_seen)


def test_what_the_storage_does_not_give_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a trial that continues would write its metrics again without what could not be read for a moment."""

    def unreachable(path: Path, limit: int) -> bytes:
        raise (OSError(errno.EIO, "Input/output error") if path.exists() else FileNotFoundError)

    (tmp_path / "metrics.jsonl").touch()
    monkeypatch.setattr(damage, "read_file", unreachable)
    with pytest.raises(StorageFailure, match="cannot read"):
        load_metrics(tmp_path / "metrics.jsonl")
    assert "cannot read" in str(read_trial(tmp_path).damages[0])
    assert read_object(tmp_path / "none.json", dict) is None


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """Two finished trials and one that runs with half its worlds."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "base.yaml").write_text(dump_yaml({"env": {"name": "cartpole", "nworld": 8}, "trial": {"epochs": 4}}))
    data = {"question": "?", "base": "base.yaml", "parameters": {"shac.actor_lr": {"grid": [0.1, 0.2, 0.3]}}}
    space = parse_space(data, folder / "s.yaml")
    trials = resolve_trials(space)
    made = opening.create(folder / "runs" / "e", space, trials, {})
    for trial in trials:
        own = made.trial_folder(trial.id)
        own.mkdir()
        (own / "metrics.jsonl").write_text("".join(json.dumps(row(epoch)) + "\n" for epoch in range(5)))
        (own / "device.json").write_text(json.dumps({"host": "h", "visible": "", "count": 0, "name": "cpu"}))
        (own / "config.yaml").write_text(dump_yaml(trial.config.as_dict()))
        write_ending(own, Ending(Outcome.FINISHED, "all 4 epochs done"))
    Attempt(WorldReduction(8, 4, "no room", cleared=True)).write(own)
    (made.path / "summary.json").write_text("{}")
    return made


def flip(data: bytes, rng: random.Random) -> bytes:
    damaged = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        damaged[rng.randrange(len(damaged))] = rng.randrange(256)
    return bytes(damaged)


def odd_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    lines[rng.randrange(len(lines))] = rng.choice(ODD_LINES)
    return b"\n".join(lines)


KINDS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "flipped": flip,
    "cut": lambda data, rng: data[: rng.randrange(len(data))],
    "zeroed": lambda data, rng: bytes(len(data)),
    "odd line": odd_line,
    "odd file": lambda data, rng: rng.choice(ODD_LINES),
    "UTF-16": lambda data, rng: data.decode().encode("utf-16"),
    "empty": lambda data, rng: b"",
}


def damaged_files() -> Iterator[tuple[str, str, int]]:
    own = ("metrics.jsonl", "outcome.json", "halved.json", "device.json", "config.yaml")
    for name in (*own, "manifest.json", "env.json", "summary.json", "space.yaml"):
        for kind in KINDS:
            for seed in range(4):
                yield name, kind, seed


@pytest.mark.parametrize("name", sorted({name for name, _, _ in damaged_files()}))
def test_a_damaged_file_takes_down_neither_status_nor_report_nor_table(
    name: str, whole: Experiment, tmp_path: Path
) -> None:
    """Of the trials that were left alone, nothing changes; what cannot be shown is one line."""
    victim = whole.trials()[2].id
    for number, (file, kind, seed) in enumerate(damaged_files()):
        if file != name:
            continue
        made = Experiment(Path(shutil.copytree(whole.path, tmp_path / str(number))))
        path = made.path / file if (made.path / file).exists() else made.trial_folder(victim) / file
        path.write_bytes(KINDS[kind](path.read_bytes(), random.Random(f"{file} {kind} {seed}")))
        reading = read_experiment(made, time.time())
        assert all("\n" not in note for note in reading.warnings)
        made.resume_command()
        if name == "manifest.json":
            with contextlib.suppress(MskRayError):  # what is still a manifest may be one of other trials
                ExperimentReader(made).planned()
                read_records(made)
            continue
        reader = ExperimentReader(made, keep_rows=False)
        short, _ = reader.look(time.time(), reader.planned())
        records = read_records(made)
        assert len(reading.trials) == 3
        intact = [trial for trial in reading.trials if trial.trial.id != victim]
        assert [(t.score, t.state, t.note) for t in intact] == [(8.0, State.ENDED, "")] * 2
        summary(made.name, "", records)
        table_document(made.name, "", records)
        assert [record.score for record in short if record.trial.id != victim] == [8.0, 8.0]
        shutil.rmtree(made.path)
