"""Whatever lies where a record should be, every command answers in one line, soon, and shows what is whole.

The consequences are those of the table "Damaged and hostile records" in lab/faults.md.
"""

import contextlib
import hashlib
import json
import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from msk_ray.cli import run
from msk_ray.config import dump_yaml
from msk_ray.errors import CheckpointError, MskRayError
from msk_ray.evaluate.stored import read_evaluations
from msk_ray.experiment import layout
from msk_ray.experiment.attempts import Attempt, WorldReduction
from msk_ray.experiment.checkpoint_format import read_checkpoint_file, read_facts, write_checkpoint_file
from msk_ray.experiment.damage import CATALOGUE, DEPTH, LINE, read_object
from msk_ray.experiment.evaluation_log import EvaluationLog, LogEntry
from msk_ray.experiment.manifest import MAX_TRIALS, Experiment
from msk_ray.experiment.metrics import load_metrics
from msk_ray.experiment.notes import load_notes, write_note
from msk_ray.experiment.outcomes import Ending, Outcome, load_ending, write_ending
from msk_ray.experiment.ownership import LOCK_FILE, acquire, has_living_owner
from msk_ray.files import append_text
from msk_ray.report.__main__ import main as report
from msk_ray.report.best import stored_best
from msk_ray.report.reading import read_experiment
from msk_ray.status import main as status
from msk_ray.sweep import opening
from msk_ray.sweep.space import load_space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.training.checkpoint import load_checkpoint
from msk_ray.training.loggers.jsonl import JsonLines
from msk_ray.tune import driver, finish, session
from msk_ray.tune.__main__ import main as tune

CONFIG, BEST = "config.yaml", "checkpoints/best.pt"
OF_A_TRIAL = (
    *(layout.METRICS_FILE, layout.OUTCOME_FILE, layout.ATTEMPT_FILE, layout.DEVICE_FILE, layout.EVAL_FILE),
    *(CONFIG, BEST, layout.ERROR_FILE, layout.OUTPUT_FILE),
)
OF_THE_EXPERIMENT = (
    *(layout.MANIFEST_FILE, layout.SPACE_FILE, layout.ENVIRONMENT_FILE, layout.NOTES_FILE, layout.SUMMARY_FILE),
    *(layout.EVALUATION_LOG_FILE, LOCK_FILE),
)
RECORDS = (*OF_A_TRIAL, *OF_THE_EXPERIMENT)


def row(epoch: int) -> dict[str, Any]:
    return {"epoch": epoch, "env_steps": 10 * epoch, "seconds": 0.5 * epoch, "eval/score": 2.0 * epoch}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """Two finished trials with every kind of record, and the secret file of somebody else. Not to be changed."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "secret.txt").write_text("secret\n")
    (folder / "base.yaml").write_text(dump_yaml({"env": {"name": "cartpole", "nworld": 8}, "trial": {"epochs": 4}}))
    data = {"question": "?", "base": "base.yaml", "parameters": {"shac.actor_lr": {"grid": [0.1, 0.2]}}}
    (folder / "s.yaml").write_text(dump_yaml(data))
    space = load_space(folder / "s.yaml")
    trials = resolve_trials(space)
    made = opening.create(folder / "runs" / "e", space, trials, {})
    for trial in trials:
        own = made.trial_folder(trial.id)
        (own / "checkpoints").mkdir(parents=True)
        (own / layout.METRICS_FILE).write_text("".join(json.dumps(row(epoch)) + "\n" for epoch in range(5)))
        (own / layout.DEVICE_FILE).write_text(json.dumps({"host": "h", "visible": "", "count": 0, "name": "cpu"}))
        (own / layout.EVAL_FILE).write_text(json.dumps({"format": 1, "evaluations": []}))
        (own / CONFIG).write_text(dump_yaml(trial.config.as_dict()))
        (own / layout.OUTPUT_FILE).write_text("starting\n")
        (own / layout.ERROR_FILE).write_text("ValueError: it is over\n")
        write_checkpoint_file(own / BEST, b"weights", {"epoch": 4})
        Attempt(WorldReduction(8, 4, "no room", cleared=True)).write(own)
        write_ending(own, Ending(Outcome.FINISHED, "all 4 epochs done"))
        write_note(made.path, trial.id, "mine")
    EvaluationLog(made.path / layout.EVALUATION_LOG_FILE).append(LogEntry("a", 1, 10, 0.5, 1.0, False))
    (made.path / layout.SUMMARY_FILE).write_text("{}")
    return made


def device(path: Path) -> None:
    try:
        os.mknod(path, stat.S_IFCHR | 0o600, os.makedev(1, 5))  # of zeros without end
    except PermissionError:
        pytest.skip("only root can make a device")


def huge(path: Path) -> None:
    """Without taking any room."""
    path.touch()
    os.truncate(path, 1 << 40)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "nested deep": lambda path: path.write_bytes(b"[" * 50_000),
    "nested a hundred deep": lambda path: path.write_bytes(b'{"a":' * 100 + b"1" + b"}" * 100 + b"\n"),
    "a number": lambda path: path.write_bytes(b"7\n"),
    "not UTF-8": lambda path: path.write_bytes(b'\xff\xfe{"format": 1}\n'),
    "half a character": lambda path: path.write_bytes(b'{"outcome": "error", "why": "\\ud800", "trials": {}}\n'),
    "NUL bytes": lambda path: path.write_bytes(bytes(512) + b"\n"),
    "huge": huge,
    "a pipe": os.mkfifo,
    "a device": device,
    "a folder": os.mkdir,
    "a link out": lambda path: path.symlink_to(path.parents[3 if path.parent.name == "e" else 5] / "secret.txt"),
}
IRREGULAR = ("huge", "a pipe", "a device", "a folder", "a link out")
"""Damages by what the file is, whatever it holds."""


@pytest.fixture
def without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver does everything but run trials."""
    monkeypatch.setattr(session, "ray_session", lambda address: contextlib.nullcontext())
    monkeypatch.setattr(driver, "run_trials", lambda plan: True)
    monkeypatch.setattr(finish, "write_report", lambda experiment: None)


def codes(record: str, damage: str) -> dict[str, int]:
    """The exit code of each command, as the table in docs/runner/faults.md has it."""
    refused = {layout.MANIFEST_FILE: ("status", "tune"), LOCK_FILE: ("tune",)}.get(record, ())
    if record == layout.METRICS_FILE and damage in IRREGULAR:
        refused = ("tune",)
    expected = {command: 2 if command in refused else 0 for command in ("status", "tune")}
    if (record, damage) == (layout.SUMMARY_FILE, "a folder"):
        expected["tune"] = 75  # it is written, never read, and there is no room for it
    return expected


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("record", RECORDS)
def test_a_hostile_record_is_one_line_and_hides_nothing_else(
    record: str, damage: str, whole: Experiment, tmp_path: Path, without_ray: None, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(whole.path.parent.parent, tmp_path, dirs_exist_ok=True)
    made = Experiment(tmp_path / "runs" / "e")
    healthy, victim = (trial.id for trial in made.trials())
    path = (made.trial_folder(victim) if record in OF_A_TRIAL else made.path) / record
    path.unlink(missing_ok=True)
    DAMAGES[damage](path)

    expected = codes(record, damage)
    space = ["--space", str(tmp_path / "s.yaml"), "--name", "e", "--storage", str(made.path.parent), "--cpu"]
    commands: dict[str, Callable[[], int]] = {
        "status": lambda: run(status, [str(made.path)]),
        "tune": lambda: run(tune, [*space, "--resume"]),
    }
    for name, command in commands.items():
        assert command() == expected[name], name
        shown = capsys.readouterr()
        lines = shown.err.splitlines()
        assert len(lines) == (1 if expected[name] else 0), lines
        assert "Traceback" not in shown.out
        assert "secret" not in shown.out + shown.err
        if expected[name]:
            assert lines[0].startswith("error: ")
            assert path.name in lines[0]
        elif name == "status":
            assert healthy in shown.out

    reading = read_experiment(made, 0.0)
    told = "\n".join([*reading.warnings, *(f"{trial.why} {trial.tail()}" for trial in reading.trials)])
    assert all("\n" not in line for line in reading.warnings)
    assert "secret" not in told
    (intact,) = [trial for trial in reading.trials if trial.trial.id == healthy]
    assert intact.score == 8.0
    assert stored_best(intact, []).missing == ()
    for trial in reading.trials:
        assert "\n" not in "".join(stored_best(trial, []).missing)


READERS: dict[str, Callable[[Path], object]] = {
    layout.OUTCOME_FILE: lambda path: load_ending(path.parent),
    layout.NOTES_FILE: lambda path: load_notes(path.parent),
    layout.EVAL_FILE: read_evaluations,
    layout.PARAMS_FILE: lambda path: read_object(path, dict),
    layout.MANIFEST_FILE: lambda path: Experiment(path.parent).manifest(),
    "best.pt": read_facts,
    "epoch_000001.pt": read_checkpoint_file,
    "policy_000001.pt": load_checkpoint,
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("record", READERS)
def test_every_reader_refuses_it_in_one_line(record: str, damage: str, tmp_path: Path) -> None:
    path = tmp_path / "1" / "2" / "3" / "4" / "5" / record
    path.parent.mkdir(parents=True)
    (tmp_path / "secret.txt").write_text("secret")
    DAMAGES[damage](path)
    with pytest.raises(MskRayError) as caught:
        READERS[record](path)
    assert record in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("damage", IRREGULAR)
def test_nothing_is_appended_to_what_is_no_file(damage: str, tmp_path: Path) -> None:
    folder = tmp_path / "1" / "2" / "3" / "4" / "5"
    folder.mkdir(parents=True)
    (tmp_path / "secret.txt").write_text("secret")
    path = folder / layout.METRICS_FILE
    DAMAGES[damage](path)
    if damage != "huge":
        with pytest.raises(MskRayError, match=r"cannot write .*metrics\.jsonl: "):
            append_text(path, "more")
    with pytest.raises(MskRayError, match=r"metrics\.jsonl"):
        JsonLines(folder).rewind(3)
    assert (tmp_path / "secret.txt").read_text() == "secret"


def head_of(line: bytes, payload: bytes = b"") -> bytes:
    """A checkpoint with this head, whose checksums are right."""
    return b"msk_ray checkpoint 2 " + hashlib.sha256(line).hexdigest().encode() + b"\n" + line + b"\n" + payload


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"7", "its head is a whole number instead of a JSON object"),
        (b"null", "its head is null"),
        (b"[" * 20_000, "its head is more than"),
        (b'{"a":' * 100 + b"1" + b"}" * 100, f"more than {DEPTH} objects and lists inside each other"),
        (b'{"bytes": "0", "sha256": ""}', "bytes is text instead of a whole number"),
        (b'{"bytes": 0, "sha256": 3}', "sha256 is a whole number instead of text"),
        (b'{"bytes": 0, "sha256": "", "epoch": []}', "epoch is a list"),
        (b'{"bytes": 9, "sha256": ""}', "is torn: 0 bytes of 9"),
    ],
)
def test_a_hostile_head_of_a_checkpoint_is_named(line: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "best.pt"
    path.write_bytes(head_of(line))
    for read in (read_facts, read_checkpoint_file, load_checkpoint):
        with pytest.raises(CheckpointError, match=r"best\.pt") as caught:
            read(path)
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_checkpoint_larger_than_any_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "best.pt"
    path.write_bytes(head_of(json.dumps({"bytes": 1 << 40, "sha256": ""}).encode()))
    os.truncate(path, path.stat().st_size + (1 << 40))
    with pytest.raises(CheckpointError, match="more than any checkpoint"):
        read_checkpoint_file(path)


def test_a_checkpoint_that_a_user_names_may_be_a_link(tmp_path: Path) -> None:
    write_checkpoint_file(tmp_path / "epoch_000001.pt", b"weights", {"epoch": 1})
    (tmp_path / "latest.pt").symlink_to("epoch_000001.pt")
    assert read_checkpoint_file(tmp_path / "latest.pt")[1] == b"weights"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"{}," * 3_000_000 + b"{}", f"3000001 trials, more than {MAX_TRIALS}"),
        (b"0," * (CATALOGUE.count + 1) + b"0", f"more than {CATALOGUE.count} values"),
    ],
    ids=["three million trials", "twenty million values"],
)
def test_a_manifest_of_millions_is_refused_before_anything_is_made_of_it(
    text: bytes, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / layout.MANIFEST_FILE).write_bytes(b'{"format": 1, "trials": [' + text + b"]}")
    assert run(status, [str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    (warning, *_) = read_experiment(Experiment(tmp_path), 0.0).warnings
    assert message in warning


def test_a_command_that_is_no_utf8_is_shown_escaped(whole: Experiment, tmp_path: Path) -> None:
    """Python stands half a character for a byte of a path that is no text."""
    made = Experiment(Path(shutil.copytree(whole.path, tmp_path / "e")))
    path = made.path / layout.ENVIRONMENT_FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | {"command": ["tune", "--storage", "\udcff"]}))
    assert run(report, [str(made.path), "--best", "never"]) == 0
    assert "\\xff" in (made.path / "report" / "index.html").read_text()


def test_what_is_written_can_be_read_again(tmp_path: Path) -> None:
    """A reason without end would make a trial that has ended one that has not."""
    write_ending(tmp_path, Ending(Outcome.ERROR, "no, " * (1 << 20)))
    ending = load_ending(tmp_path)
    assert ending is not None
    assert ending.why.startswith("no, no, ")
    assert ending.why.endswith("...")


def test_a_row_within_the_limits_is_read_and_one_beyond_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / layout.METRICS_FILE
    wide = row(1) | {f"metric/{number}": 1.0 for number in range(LINE.count - 10)}
    wider = row(2) | {f"metric/{number}": 1.0 for number in range(LINE.count + 1)}
    path.write_text("".join(json.dumps(r) + "\n" for r in (wide, wider, row(3))))
    metrics = load_metrics(path)
    assert [r["epoch"] for r in metrics.rows] == [1, 3]
    assert str(metrics.damages[0]).endswith(f"line 2: more than {LINE.count} values")


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_lock_that_is_none_is_judged_by_its_age(damage: str, tmp_path: Path) -> None:
    folder = tmp_path / "1" / "2" / "3" / "4" / "5"
    folder.mkdir(parents=True)
    (tmp_path / "secret.txt").write_text("secret")
    lock = folder / LOCK_FILE
    DAMAGES[damage](lock)
    now = lock.lstat().st_mtime
    assert has_living_owner(folder, now) is True
    assert has_living_owner(folder, now + 3600) is False
    with pytest.raises(MskRayError, match=r"owner\.json is damaged"):
        acquire(folder)
