"""Real Ray, a trainer of milliseconds: faults, what has gone, and memory."""

import json
import re
import threading
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from needs import slow
from ray import cloudpickle
from stub_runs import go, outcomes
from stub_trainer import (
    BEHAVIOUR,
    BROKEN_CONNECTION,
    BUG,
    DOOMED_CROWD,
    EXIT,
    EXIT_ZERO,
    FULL_DISK,
    HANG,
    INTERRUPT,
    KILL,
    LATE_CROWD,
    MEMORY,
    NAN,
    ROOM,
    SIMULATION_ERROR,
    StubTrainer,
)

from msk_ray.errors import StorageFailure
from msk_ray.experiment.attempts import Attempt, WorldReduction, read_attempt
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.outcomes import Outcome
from msk_ray.sweep import opening
from msk_ray.sweep.rules.stopping import StopSpec
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune.shared_trials import SharedTrials
from msk_ray.tune.trainable import Job
from msk_ray.tune.trial_run import Hooks, run_trial

pytestmark = [pytest.mark.usefixtures("stub_session"), pytest.mark.long]


class Fault(NamedTuple):
    """What becomes of a trial that behaves in some way."""

    outcome: str
    epochs: int
    why: str = ""
    """What an error says."""
    shown: str = ""
    """What the terminal shows of it."""


FAULTS = {
    0.0: Fault("finished", 20),
    KILL: Fault("finished", 20, shown="its process died (killed, or out of memory); retrying"),
    HANG: Fault("finished", 20, shown="it hung; its stacks are in"),
    NAN: Fault("nonfinite", 5, "train/actor_loss is nan at epoch 5"),
    EXIT: Fault("error", 4, "sys.exit(3) was called"),
}
MORE_FAULTS = {
    0.0: Fault("finished", 20),
    BROKEN_CONNECTION: Fault("finished", 20, shown="ConnectionResetError: [Errno 104] made up; retrying"),
    SIMULATION_ERROR: Fault("nonfinite", 4, "nonfinite_gradient: made up"),
    BUG: Fault("error", 4, "RuntimeError: made up"),
    EXIT_ZERO: Fault("error", 4, "sys.exit(0) was called"),
    INTERRUPT: Fault("error", 4, "KeyboardInterrupt"),
}


@pytest.mark.parametrize("faults", [FAULTS, *slow(MORE_FAULTS)], ids=["of all kinds", "more"])
def test_faults_are_named_and_killed_or_hung_trials_go_on(
    faults: dict[float, Fault], make_space: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = make_space(
        parameters={BEHAVIOUR: {"grid": list(faults)}},
        resources={"max_failures": 1, "hang_s": 3.0},
    )
    completed, records = go(space, tmp_path / "runs" / "faults")
    assert completed
    shown = capsys.readouterr()
    for record, fault in zip(records, faults.values(), strict=True):
        assert (outcomes([record]), record.epochs_done) == ([fault.outcome], fault.epochs)
        assert record.ending is not None
        assert fault.why in record.ending.why
        assert fault.shown in shown.out
        if fault.outcome == "error":
            # Another process would meet it again.
            assert processes_in(record.folder) == 1
            assert re.fullmatch(rf"{re.escape(fault.why)} \(stub_trainer\.py:\d+, in _misbehave\)", record.ending.why)
            assert f"{record.trial.id} error: {record.ending.why}; see {record.folder}" in shown.out
            assert (record.folder / "error.txt").is_file()
    assert "raylet" not in shown.out + shown.err  # Ray's own notices are in ray.log
    # A killed trial has every epoch once, with the scores of the one that was left alone.
    for record in records:
        if outcomes([record]) == ["finished"]:
            scores = [row["eval/score"] for row in read_rows(record.folder) if "eval/score" in row]
            assert scores == [row["eval/score"] for row in read_rows(records[0].folder) if "eval/score" in row]
            assert len(scores) == 11
    facts = json.loads((tmp_path / "runs" / "faults" / "summary.json").read_text())
    assert [trial["outcome"] for trial in facts["trials"]] == outcomes(records)
    for name in ("table.md", "env.json", "manifest.json"):
        assert (tmp_path / "runs" / "faults" / name).is_file()


def test_a_trial_that_training_makes_worse_is_shown_with_the_score_it_is_ranked_by(
    make_space: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where no later policy is better than the untrained one, which scores 0, the best of the trained ones counts."""
    _, records = go(make_space(parameters={"shac.actor_lr": {"grid": [1e-5]}}), tmp_path / "runs" / "worse")
    assert records[0].best is not None
    # −50 (1 − e^(−epoch/10)) falls from its first evaluation on.
    assert (records[0].best.score, records[0].best.epoch) == (pytest.approx(-9.0635, abs=1e-4), 2)
    shown = capsys.readouterr().out
    assert "finished: all 20 epochs done; best score -9.0635" in shown
    assert "best so far: score -9.0635 at epoch 2/20" in shown
    assert "score 0" not in shown


def test_a_full_disk_stops_everything_and_ends_nothing(
    make_space: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = make_space(parameters={BEHAVIOUR: {"grid": [FULL_DISK, MEMORY]}})
    path = tmp_path / "runs" / "disk"
    with pytest.raises(StorageFailure, match="No space left on device; fix that and continue with --resume"):
        go(space, path)
    assert "stopping all trials" in capsys.readouterr().out
    completed, records = go(space, path, resume=True)
    assert completed
    assert outcomes(records) == ["finished", "out_of_memory"]


def processes_in(folder: Path) -> int:
    """How many processes have begun a trial in its folder."""
    path = folder / "processes"
    return len(path.read_text().splitlines()) if path.exists() else 0


def gone(path: Path, what: str, before: threading.Event, lost: list[Path]) -> None:
    """Once a trial has written some rows, move the experiment's folder, its manifest, or the trial's folder away, and
    add to `lost` what that was."""
    while True:
        written = [file for file in path.glob("trials/*/metrics.jsonl") if len(file.read_bytes().splitlines()) > 8]
        if written or before.wait(0.05):
            break
    source = {"experiment": path, "manifest": path / "manifest.json", "trial": written[0].parent}[what]
    source.rename(path.parent / "elsewhere")
    lost.append(source)


@pytest.mark.parametrize("what", ["experiment", *slow("manifest", "trial")])
def test_what_has_gone_stops_the_sweep_and_is_not_made_again(
    what: str, make_space: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fails where a trial makes its folder: it begins again at epoch 0, and the sweep ends as if it had finished."""
    monkeypatch.setattr(StubTrainer, "seconds_per_epoch", 0.2)
    space = make_space(overrides={"trial.epochs": 60}, resources={"max_failures": 3})
    path = tmp_path / "runs" / "gone"
    ended, moved = threading.Event(), list[Path]()
    mover = threading.Thread(target=gone, args=(path, what, ended, moved))
    mover.start()
    with pytest.raises(StorageFailure, match=r"does not exist|cannot write") as caught:
        go(space, path)
    ended.set()
    mover.join()
    assert caught.value.exit_code == 75
    assert "continue with --resume" in str(caught.value)
    elsewhere = path.parent / "elsewhere"
    (lost,) = moved
    assert not lost.exists()
    elsewhere.rename(lost)
    rows = {t.id: read_rows(path / "trials" / t.id) for t in resolve_trials(space)}
    before = {t.id: processes_in(path / "trials" / t.id) for t in resolve_trials(space)}
    assert 1 in before.values()
    assert set(before.values()) <= {0, 1}  # on a busy machine, one may not have begun when the files went
    completed, records = go(space, path, resume=True)
    assert completed
    assert outcomes(records) == ["finished", "finished"]
    for record in records:
        resumed = read_rows(record.folder)
        assert [row["epoch"] for row in resumed] == list(range(61))
        kept = rows[record.trial.id]
        assert [row["eval/score"] for row in kept[::2]] == [row["eval/score"] for row in resumed[: len(kept) : 2]]
        # One process more: it went on from its checkpoint rather than from nothing.
        assert processes_in(record.folder) == before[record.trial.id] + 1


def test_out_of_memory_begins_again_with_half_the_worlds_in_a_fresh_process(
    make_space: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = make_space(
        parameters={BEHAVIOUR: {"grid": [0.0, LATE_CROWD, MEMORY, DOOMED_CROWD]}},
        # No death is forgiven, and another attempt is none.
        resources={"max_failures": 0, "halve_worlds_on_oom": True},
        scheduler={"kind": "asha", "grace": 0.9},
    )
    path = tmp_path / "runs" / "crowded"
    completed, records = go(space, path)
    shown = capsys.readouterr().out
    assert completed
    assert outcomes(records) == ["finished", "finished", "out_of_memory", "error"]
    assert [record.attempt.number for record in records] == [1, 2, 2, 2]
    assert {str(record.attempt) for record in records[1:]} == {f"half the worlds: {ROOM} of 8"}
    assert "8 worlds were asked for, and half" in records[2].ending.why  # type: ignore[union-attr]
    assert records[3].ending.why == "its process died (killed, or out of memory)"  # type: ignore[union-attr]
    for record in records[1:]:
        processes = (record.folder / "processes").read_text().split()
        assert len(processes) == len(set(processes)) == 2
        assert f"{record.trial.id} ran out of memory; it restarts with half the worlds: 4 of 8" in shown
        assert f"{record.trial.id} again  {record.trial.variant} seed=0 (half the worlds: 4 of 8)" in shown
    for record in records[:2]:
        assert [row["epoch"] for row in read_rows(record.folder)] == list(range(21))
    # What the rule heard of the attempt with all worlds is heard again with half of them.
    heard = [json.loads(line) for line in (path / "reports.jsonl").read_text().splitlines()]
    late = [(report["attempt"], report["epoch"]) for report in heard if report["trial"] == records[1].trial.id]
    assert late == [(1, 2), (1, 4), *((2, epoch) for epoch in range(2, 21, 2))]
    assert "3 trials ran with half the worlds asked for" in shown
    assert shown.count("finished, half the worlds") == 1
    # The one whose process was killed between the decision and its first epoch continues with its half.
    Experiment(path).clear_endings({Outcome.ERROR})
    completed, records = go(space, path, resume=True)
    assert outcomes(records)[3] == "finished"
    assert str(records[3].attempt) == "half the worlds: 4 of 8"
    assert "(half the worlds: 4 of 8)" in capsys.readouterr().out


def test_a_search_goes_on_with_half_the_worlds(make_space: Any, tmp_path: Path) -> None:
    pytest.importorskip("optuna")
    space = make_space(
        parameters={"shac.actor_lr": {"loguniform": [1e-3, 1e-2]}},
        search="optuna",
        overrides={"trial.epochs": 6, BEHAVIOUR: LATE_CROWD},
        resources={"max_failures": 0, "halve_worlds_on_oom": True},
    )
    completed, (record,) = go(space, tmp_path / "runs" / "optuna")
    assert completed
    assert outcomes([record]) == ["finished"]
    assert record.attempt.number == 2
    assert [row["epoch"] for row in read_rows(record.folder)] == list(range(7))


def test_a_driver_killed_after_the_decision_goes_on_with_half_the_worlds(make_space: Any, tmp_path: Path) -> None:
    space = make_space(parameters={BEHAVIOUR: {"grid": [LATE_CROWD]}}, resources={"halve_worlds_on_oom": True})
    path = tmp_path / "runs" / "killed"
    (trial,) = resolve_trials(space)
    folder = opening.create(path, space, [trial], {}).trial_folder(trial.id)
    folder.mkdir(parents=True)
    # As far as a driver came that was killed there.
    assert run_trial(trial, folder, "cpu", StopSpec(), StubTrainer, Hooks(), may_halve=True) is None
    # The resumed sweep may not halve, and need not: the decision has been made.
    completed, (record,) = go(make_space(parameters={BEHAVIOUR: {"grid": [LATE_CROWD]}}), path, True)
    assert completed
    assert outcomes([record]) == ["finished"]
    assert (
        record.attempt == Attempt(WorldReduction(8, 4, "out_of_memory: made up", cleared=True)) == read_attempt(folder)
    )
    assert [row["epoch"] for row in read_rows(folder)] == list(range(21))


def test_what_tune_unpickles_for_each_trial_does_not_grow_with_their_number(make_space: Any, tmp_path: Path) -> None:
    sizes = []
    for seeds in ("10-19", "10-99"):
        space = make_space(seeds=seeds)
        trials = resolve_trials(space)
        job = Job(Experiment(tmp_path), space, {}, SharedTrials(trials), "cpu", 0.0, StubTrainer)
        pickled = cloudpickle.dumps(job)
        sizes.append(len(pickled))
        assert cloudpickle.loads(pickled).trial_of({"id": trials[-1].id}) == trials[-1]
    assert sizes[1] - sizes[0] < 1000, "80 trials have 60 KB"
