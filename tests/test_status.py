"""`status` on folders in every condition: at work, dead, torn, empty, missing."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from processes import Launcher, wait_until

from msk_ray.cli import run
from msk_ray.config import dump_yaml
from msk_ray.experiment.attempts import FIRST, Attempt, WorldReduction
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import progress_of
from msk_ray.experiment.outcomes import Ending, Outcome, write_ending
from msk_ray.experiment.ownership import owned
from msk_ray.experiment.records import ExperimentReader, TrialRecord, best_records, in_order, remaining
from msk_ray.experiment.snapshot import State
from msk_ray.status import FIRST_EPOCH, main, short_number
from msk_ray.sweep import opening
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune.console import BEFORE_FIRST, Console

NOW = time.time()
GPU = {"host": "node7", "pid": 1, "visible": "3", "count": 1, "name": "NVIDIA H200"}


@pytest.fixture(autouse=True)
def now() -> None:
    """Ages are counted from the test's own start: a busy machine may come to it minutes after this file was read."""
    global NOW
    NOW = time.time()


def row(epoch: int, score: float | None = None) -> dict[str, Any]:
    """An epoch takes 4 s and gives 12 345 env steps/s."""
    base = {"epoch": epoch, "env_steps": 100 * epoch, "seconds": 4.0 * epoch, "env_steps_per_s": 12345.0}
    return base if score is None else base | {"eval/score": score}


def fill(folder: Path, rows: list[dict[str, Any]], age: float, device: dict[str, Any] | None = None) -> None:
    """A trial's folder whose metrics are `age` seconds old and whose process started before."""
    folder.mkdir(parents=True)
    (folder / "device.json").write_text(json.dumps(device or GPU))
    os.utime(folder / "device.json", (NOW - age - 100, NOW - age - 100))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows) + '{"epoch": 9')
    os.utime(folder / "metrics.jsonl", (NOW - age, NOW - age))


@pytest.fixture
def experiment(now: None, tmp_path: Path) -> Experiment:
    """Six rates: running, silent, finished, stopped, never started, and one with a broken file."""
    (tmp_path / "base.yaml").write_text(dump_yaml({"env": {"name": "cartpole"}, "trial": {"epochs": 20}}))
    data = {
        "question": "Which rate?",
        "base": "base.yaml",
        "parameters": {"shac.actor_lr": {"grid": [1e-2, 2e-2, 3e-2, 4e-2, 5e-2, 6e-2]}},
    }
    space = parse_space(data, tmp_path / "small.yaml")
    trials = resolve_trials(space)
    made = opening.create(tmp_path / "runs" / "rates", space, trials, {})
    folders = [made.trial_folder(trial.id) for trial in trials]
    fill(folders[0], [row(0, 1.0), row(5, 7.0), row(8)], age=5.0)
    fill(folders[1], [row(0, 1.0), row(3), row(4, 3.0)], age=41.0 * 4)  # ten epochs are 40 s, but never less than 60 s
    fill(folders[2], [row(0), row(20, 9.0)], age=999.0, device=GPU | {"count": 0})
    write_ending(folders[2], Ending(Outcome.FINISHED, "all done"))
    fill(folders[3], [row(0), row(4, 2.0)], age=999.0)
    write_ending(folders[3], Ending(Outcome.STOPPED_ASHA, "number 3 of 3"))
    fill(folders[5], [row(1)], age=999.0)
    (folders[5] / "outcome.json").write_text('{"outc')
    return made


def records_of(experiment: Experiment) -> list[TrialRecord]:
    reader = ExperimentReader(experiment, keep_rows=False)
    return in_order(reader.look(NOW, reader.planned())[0])


def record_of(experiment: Experiment, trial: str) -> TrialRecord:
    (record,) = [record for record in records_of(experiment) if record.trial.id == trial]
    return record


@pytest.fixture
def driven(experiment: Experiment) -> Iterator[Experiment]:
    """The same while this process is its driver."""
    with owned(experiment.path):
        yield experiment


def test_states_from_files(experiment: Experiment) -> None:
    records = records_of(experiment)
    assert [s.state for s in records] == [
        State.RUNNING,
        State.INTERRUPTED,
        State.INTERRUPTED,
        State.ENDED,
        State.ENDED,
        State.WAITING,
    ]
    running = records[0]
    assert (running.progress.epoch, running.progress.best, running.progress.env_steps_per_s) == (8, 7.0, 12345.0)
    assert running.seconds_left == (20 - 8) * 4.0
    assert running.beat == pytest.approx(NOW - 5.0, abs=0.1)
    assert (running.device.gpu, records[3].device.gpu) == ("3", "cpu")
    assert [s.outcome for s in records[3:5]] == ["finished", "stopped_asha"]  # the higher score first
    best = best_records(records).get("cartpole")
    assert best is records[3]
    # One trial at a time and 4 s an epoch: 12 epochs of the running one, 16 and 19 of the silent, 20 of the waiting.
    assert remaining(records) == (12 + 16 + 19 + 20) * 4.0


@pytest.mark.parametrize(("age", "state"), [(59.0, State.RUNNING), (61.0, State.STALE), (-50.0, State.RUNNING)])
def test_stale_after_a_minute_at_four_seconds_an_epoch(driven: Experiment, age: float, state: State) -> None:
    experiment = driven
    folder = experiment.trial_folder(experiment.trials()[0].id)
    os.utime(folder / "metrics.jsonl", (NOW - age, NOW - age))
    os.utime(folder / "device.json", (NOW - 900, NOW - 900))
    assert record_of(experiment, folder.name).state is state


@pytest.mark.parametrize(("age", "state"), [(4.0, State.INTERRUPTED), (6.0, State.RUNNING)])
def test_a_trial_whose_driver_has_left_is_not_running(experiment: Experiment, age: float, state: State) -> None:
    """The running one was heard of 5 s ago: before the driver wrote its summary, or, resumed since, after."""
    summary = experiment.path / "summary.json"
    summary.write_text("{}")
    os.utime(summary, (NOW - age, NOW - age))
    trial = experiment.trials()[0].id
    assert record_of(experiment, trial).state is state


def test_an_interrupted_trial_waits_for_a_driver_that_resumes_it(driven: Experiment) -> None:
    (driven.path / "summary.json").write_text("{}")
    assert {s.state for s in records_of(driven)} == {State.ENDED, State.WAITING}


def test_a_killed_driver_leaves_interrupted_trials_at_once(
    experiment: Experiment, launcher: Launcher, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing was written since, and the running one was heard of 5 s ago."""
    script = "import sys, time; from pathlib import Path; from msk_ray.experiment.ownership import acquire"
    script += "; acquire(Path(sys.argv[1])); time.sleep(3600)"
    killed = launcher.start([sys.executable, "-c", script, str(experiment.path)])
    wait_until(lambda: (experiment.path / "owner.json").exists(), killed)
    trial = experiment.trials()[0].id
    assert record_of(experiment, trial).state is State.RUNNING
    killed.kill()
    killed.wait()
    assert record_of(experiment, trial).state is State.INTERRUPTED
    assert run(main, ["rates", "--storage", str(experiment.path.parent)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "3 interrupted" in shown
    assert f"interrupted; continue with: {experiment.resume_command()}" in shown


def test_a_process_that_has_just_started_may_take_minutes_to_compile(driven: Experiment) -> None:
    experiment = driven
    folder = experiment.trial_folder(experiment.trials()[1].id)
    for age, state in ((500.0, State.RUNNING), (700.0, State.STALE)):
        os.utime(folder / "metrics.jsonl", (NOW - 5000, NOW - 5000))
        os.utime(folder / "device.json", (NOW - age, NOW - age))
        assert record_of(experiment, folder.name).state is state


def test_a_changed_file_is_read_again_and_another_is_not(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    from msk_ray.experiment import snapshot

    read: list[str] = []
    original = snapshot.load_metrics
    monkeypatch.setattr(snapshot, "load_metrics", lambda path: (read.append(path.parent.name), original(path))[1])
    reader = ExperimentReader(experiment, keep_rows=False)
    reader.look(NOW, reader.planned())
    read.clear()
    folder = experiment.trial_folder(experiment.trials()[0].id)
    (folder / "metrics.jsonl").write_text(json.dumps(row(9, 8.0)) + "\n")
    first = reader.look(NOW, reader.planned())[0][0]
    assert read == [folder.name]
    assert (first.progress.epoch, first.progress.best) == (9, 8.0)


def test_trials_a_search_makes_up_are_found_before_the_manifest_knows_them(experiment: Experiment) -> None:
    trials = experiment.trials()
    (experiment.trial_folder(trials[0].id) / "config.yaml").write_text(dump_yaml(trials[0].config.as_dict()))
    experiment.set_trials(trials[1:])
    suggested = record_of(experiment, trials[0].id)
    assert (suggested.state, suggested.trial.variant, suggested.trial.epochs) == (State.RUNNING, "actor_lr=0.01", 20)


def test_what_a_trial_does_before_its_first_epoch_is_said(
    driven: Experiment, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = driven.trial_folder(driven.trials()[4].id)
    fill(folder, [row(0, 1.0)], age=5.0)
    record = record_of(driven, folder.name)
    assert (record.state, record.seconds_left) == (State.RUNNING, None)
    monkeypatch.setenv("COLUMNS", "300")
    assert run(main, ["rates", "--storage", str(driven.path.parent)]) == 0
    assert FIRST_EPOCH in capsys.readouterr().out
    console = Console(driven.trials(), 1)
    console.started(driven.trials()[4], FIRST)
    console.say(console.status())
    assert f"0/20  no evaluation in 0s: {BEFORE_FIRST}" in capsys.readouterr().out


def test_progress_of_nothing_and_of_scores_that_are_no_numbers() -> None:
    assert progress_of([]).best is None
    rows = [row(0), row(1, float("nan")), row(2, float("nan"))]
    assert progress_of(rows[:2]).seconds_per_epoch is None, "the first one includes compilation"
    assert (progress_of(rows).best, progress_of(rows).epoch, progress_of(rows).seconds_per_epoch) == (None, 2, 4.0)


@pytest.mark.parametrize("width", [80, 200])
def test_the_table_fits_the_terminal(
    experiment: Experiment,
    width: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    assert run(main, ["rates", "--storage", str(experiment.path.parent)]) == 0
    text = capsys.readouterr().out
    lines = text.splitlines()
    assert max(map(len, lines)) <= width
    assert lines[0].startswith("rates · 1 running · 2 interrupted · 1 waiting · 2 ended · best 9")
    running = next(line.split() for line in lines if "running" in line and "8/20" in line)
    for cell in ("actor_lr=0.01", "8/20", "7", "12.3k", "48s"):
        assert cell in running, running
    assert "asha" in text
    assert "outcome.json: not JSON" in " ".join(text.split())  # what is wrong with the broken file
    assert "skipped: 1 damaged file" in text
    assert ("node7:3 NVIDIA H200" in text) == (width == 200)
    assert ("number 3 of 3" in text) == (width == 200)


def test_a_trial_that_ran_out_of_memory_says_what_to_lower(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = experiment.trials()[0]
    experiment.trial_folder(trial.id).mkdir(parents=True, exist_ok=True)
    why = "out_of_memory: cuda:0 has too little memory for 4096 worlds; lower env.nworld"
    write_ending(experiment.trial_folder(trial.id), Ending(Outcome.OUT_OF_MEMORY, why))
    monkeypatch.setenv("COLUMNS", "80")
    assert run(main, [experiment.name, "--storage", str(experiment.path.parent)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "lower env.nworld" in " ".join(" ".join(lines).split())
    assert any(trial.id in line and "out_of_memory" in line for line in lines)


@pytest.mark.parametrize("width", [80, 200])
def test_a_trial_with_half_its_worlds_says_so(
    experiment: Experiment,
    width: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    Attempt(WorldReduction(64, 32, "no room", cleared=True)).write(experiment.trial_folder(experiment.trials()[0].id))
    monkeypatch.setenv("COLUMNS", str(width))
    assert run(main, [experiment.name, "--storage", str(experiment.path.parent)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    text = " ".join(" ".join(lines).split())
    assert text.count("(half") == 1
    assert "32 of 64" in text


def test_an_experiment_by_path_with_a_request_to_stop(
    experiment: Experiment, capsys: pytest.CaptureFixture[str]
) -> None:
    experiment.stop_file.touch()
    assert run(main, [str(experiment.path)]) == 0
    command = experiment.resume_command()
    assert command.endswith(" --resume")
    said = "".join(capsys.readouterr().out.split())
    assert "stoppedonrequest;continuewith:" + "".join(command.split()) in said


def test_list_of_experiments(
    experiment: Experiment, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    storage = experiment.path.parent
    (storage / "debug").mkdir()
    (storage / "torn").mkdir()
    (storage / "torn" / "env.json").write_text("{}")
    (storage / "garbled").mkdir()
    (storage / "garbled" / "manifest.json").write_text('{"format": 1, "tri')
    assert run(main, ["--storage", str(storage)]) == 0
    text = capsys.readouterr().out
    assert "Which rate?" in text
    assert "1 running" in text
    said = "".join(text.split())  # where a cell is wrapped depends on how long the folder's name is
    assert "manifest.jsonismissing" in said
    assert "manifest.json:notJSON" in said
    assert "debug" not in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rate"], "did you mean 'rates'?"),
        (["nothing"], "there are rates"),
        (["torn"], "holds no experiment: manifest.json is missing"),
        (["garbled"], "manifest.json: not JSON"),
        (["odd"], "manifest.json: trials is missing; restore it"),
        (["--watch"], "which experiment? there are"),
    ],
)
def test_what_is_no_experiment_is_one_line(
    experiment: Experiment, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    storage = experiment.path.parent
    for name, text in (("torn", None), ("garbled", '{"format": 1, "tri'), ("odd", '{"format": 1}')):
        if name in arguments:
            (storage / name).mkdir()
            if text is not None:
                (storage / name / "manifest.json").write_text(text)
    assert run(main, [*arguments, "--storage", str(storage)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1


def test_an_empty_storage_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(main, ["--storage", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_watch_ends_with_the_last_trial(experiment: Experiment, capsys: pytest.CaptureFixture[str]) -> None:
    for trial in experiment.trials():
        (experiment.trial_folder(trial.id)).mkdir(exist_ok=True)
        write_ending(experiment.trial_folder(trial.id), Ending(Outcome.FINISHED, "done"))
    assert run(main, ["rates", "--watch", "--storage", str(experiment.path.parent)]) == 0
    assert "6 ended" in capsys.readouterr().out


def test_neither_ray_nor_torch_is_loaded(experiment: Experiment, root: Path) -> None:
    code = (
        "import sys; from msk_ray.status import main; "
        f"main(['rates', '--storage', {str(experiment.path.parent)!r}]); "
        "sys.exit(bool({'ray', 'torch', 'warp', 'mujoco', 'numpy'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=root, env={**os.environ, "PYTHONPATH": str(root)})
    assert result.returncode == 0


@pytest.mark.parametrize(("value", "text"), [(0.0, "0"), (950.0, "950"), (12345.0, "12.3k"), (999999.0, "1M")])
def test_short_numbers(value: float, text: str) -> None:
    assert short_number(value) == text
