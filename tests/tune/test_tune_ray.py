"""Real Ray, a trainer of milliseconds: stopping, faults, pausing and resuming."""

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import stub_trainer
from ray import cloudpickle
from stub_trainer import (
    BEHAVIOUR,
    BUG,
    CROWD,
    DOOMED_CROWD,
    FULL_DISK,
    HANG,
    KILL,
    LATE_CROWD,
    MEMORY,
    NAN,
    ROOM,
    SIMULATION_ERROR,
    StubTrainer,
)

from msk_ray.config import read_yaml
from msk_ray.errors import ClusterLost, StorageError, StorageFailure
from msk_ray.experiment.attempts import Attempt, Reduced, read_attempt
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.outcomes import Outcome
from msk_ray.experiment.results import TrialRecord, read_records
from msk_ray.sweep import opening
from msk_ray.sweep.rules.stopping import StopSpec
from msk_ray.sweep.search_trials import recover
from msk_ray.sweep.space import Space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune import driver, worker_prestart
from msk_ray.tune.devices import Placement
from msk_ray.tune.finish import finish
from msk_ray.tune.session import ray_session
from msk_ray.tune.trial_run import Hooks, run_trial


@pytest.fixture(scope="module", autouse=True)
def session() -> Iterator[None]:
    """One Ray for all tests here."""
    cloudpickle.register_pickle_by_value(stub_trainer)
    handlers = {
        number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
    }
    with ray_session(None, dashboard=False, trials=False):  # stubs need none of what trials import
        yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


def go(space: Space, path: Path, resume: bool = False) -> tuple[bool, list[TrialRecord]]:
    searching = space.file.search == "optuna"
    trials = [] if searching else resolve_trials(space)
    experiment = (
        opening.reopen(path, None if searching else trials) if resume else opening.create(path, space, trials, {})
    )
    plan = driver.Plan(experiment, space, trials, Placement(0.0, 1), None, StubTrainer, precompile=None, prestart=False)
    completed = driver.run_trials(plan)
    finish(experiment)
    return completed, read_records(experiment)


def outcomes(records: list[TrialRecord]) -> list[str | None]:
    return [record.ending and str(record.ending.outcome) for record in records]


def test_faults_are_named_and_killed_or_hung_trials_go_on(
    make_space: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    behaviours = [0.0, KILL, NAN, SIMULATION_ERROR, BUG, HANG]
    space = make_space(
        parameters={BEHAVIOUR: {"grid": behaviours}},
        resources={"max_failures": 1, "hang_s": 3.0},
    )
    completed, records = go(space, tmp_path / "runs" / "faults")
    assert completed
    assert outcomes(records) == ["finished", "finished", "nonfinite", "nonfinite", "error", "finished"]
    assert [record.epochs_done for record in records] == [20, 20, 5, 4, 4, 20]
    assert "train/actor_loss is nan at epoch 5" in records[2].ending.why  # type: ignore[union-attr]
    assert records[4].ending.why == "RuntimeError: made up"  # type: ignore[union-attr]
    shown = capsys.readouterr()
    assert "its process died (killed, or out of memory); retrying" in shown.out
    assert "raylet" not in shown.out + shown.err  # Ray's own notices are in ray.log
    assert "it hung; its stacks are in" in shown.out
    # The killed trial has every epoch once, with the scores of the one that was left alone.
    intact = (records[0], records[1], records[5])
    scores = [[row["eval/score"] for row in read_rows(r.folder) if "eval/score" in row] for r in intact]
    assert scores[0] == scores[1] == scores[2]
    assert len(scores[0]) == 11
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


def gone(path: Path, what: str, before: threading.Event) -> None:
    """Once a trial has written some rows, move the experiment's folder, its manifest, or the trial's folder away."""
    while True:
        written = [file for file in path.glob("trials/*/metrics.jsonl") if len(file.read_bytes().splitlines()) > 8]
        if written or before.wait(0.05):
            break
    source = {"experiment": path, "manifest": path / "manifest.json", "trial": written[0].parent}[what]
    source.rename(path.parent / "elsewhere")


@pytest.mark.parametrize("what", ["experiment", "manifest", "trial"])
def test_what_has_gone_stops_the_sweep_and_is_not_made_again(
    what: str, make_space: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fails where a trial makes its folder: it begins again at epoch 0, and the sweep ends as if it had finished."""
    monkeypatch.setattr(StubTrainer, "seconds_per_epoch", 0.2)
    space = make_space(overrides={"trial.epochs": 60}, resources={"max_failures": 3})
    path = tmp_path / "runs" / "gone"
    ended = threading.Event()
    mover = threading.Thread(target=gone, args=(path, what, ended))
    mover.start()
    with pytest.raises(StorageFailure, match=r"does not exist|cannot write") as caught:
        go(space, path)
    ended.set()
    mover.join()
    assert caught.value.exit_code == 75
    assert "continue with --resume" in str(caught.value)
    elsewhere = path.parent / "elsewhere"
    lost = {"experiment": path, "manifest": path / "manifest.json"}.get(what)
    if lost is None:
        (lost,) = [path / "trials" / t.id for t in resolve_trials(space) if not (path / "trials" / t.id).exists()]
    assert not lost.exists()
    elsewhere.rename(lost)
    rows = {t.id: read_rows(path / "trials" / t.id) for t in resolve_trials(space)}
    completed, records = go(space, path, resume=True)
    assert completed
    assert outcomes(records) == ["finished", "finished"]
    for record in records:
        found = read_rows(record.folder)
        assert [row["epoch"] for row in found] == list(range(61))
        kept = rows[record.trial.id]
        assert [row["eval/score"] for row in kept[::2]] == [row["eval/score"] for row in found[: len(kept) : 2]]
        # One process before and one after: it went on from its checkpoint rather than from nothing.
        assert len((record.folder / "processes").read_text().splitlines()) == 2


def test_out_of_memory_begins_again_with_half_the_worlds_in_a_fresh_process(
    make_space: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = make_space(
        parameters={BEHAVIOUR: {"grid": [0.0, CROWD, LATE_CROWD, MEMORY, DOOMED_CROWD]}},
        # No death is forgiven, and another attempt is none.
        resources={"max_failures": 0, "halve_worlds_on_oom": True},
        scheduler={"kind": "asha", "grace": 0.9},
    )
    path = tmp_path / "runs" / "crowded"
    completed, records = go(space, path)
    shown = capsys.readouterr().out
    assert completed
    assert outcomes(records) == ["finished", "finished", "finished", "out_of_memory", "error"]
    assert [record.attempt.number for record in records] == [1, 2, 2, 2, 2]
    assert {str(record.attempt) for record in records[1:]} == {f"half the worlds: {ROOM} of 8"}
    assert all("8 worlds were asked for, and half" in r.ending.why for r in records[3:4])  # type: ignore[union-attr]
    assert records[4].ending.why == "its process died (killed, or out of memory)"  # type: ignore[union-attr]
    for record in records[1:]:
        processes = (record.folder / "processes").read_text().split()
        assert len(processes) == len(set(processes)) == 2
        assert f"{record.trial.id} ran out of memory; it restarts with half the worlds: 4 of 8" in shown
        assert f"{record.trial.id} again  {record.trial.variant} seed=0 (half the worlds: 4 of 8)" in shown
    for record in records[:3]:
        assert [row["epoch"] for row in read_rows(record.folder)] == list(range(21))
    # What the rule heard of the attempt with all worlds is heard again with half of them.
    heard = [json.loads(line) for line in (path / "reports.jsonl").read_text().splitlines()]
    late = [(report["attempt"], report["epoch"]) for report in heard if report["trial"] == records[2].trial.id]
    assert late == [(1, 2), (1, 4), *((2, epoch) for epoch in range(2, 21, 2))]
    assert "4 trials ran with half the worlds asked for" in shown
    assert shown.count("finished, half the worlds") == 2
    # The one whose process was killed between the decision and its first epoch continues with its half.
    Experiment(path).clear_endings({Outcome.ERROR})
    completed, records = go(space, path, resume=True)
    assert outcomes(records)[4] == "finished"
    assert str(records[4].attempt) == "half the worlds: 4 of 8"
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
    assert record.attempt == Attempt(Reduced(8, 4, "out_of_memory: made up", cleared=True)) == read_attempt(folder)
    assert [row["epoch"] for row in read_rows(folder)] == list(range(21))


def test_a_dead_node_of_ones_own_ends_the_experiment_resumably(monkeypatch: pytest.MonkeyPatch) -> None:
    node = driver._OwnNode()
    monkeypatch.setattr(driver._OwnNode, "INTERVAL_S", 0.0)
    node.on_step_end(0, [])
    alive = driver.ray.nodes()
    monkeypatch.setattr(driver.ray, "nodes", lambda: [{**facts, "Alive": False} for facts in alive])
    with pytest.raises(ClusterLost, match="has died"):
        node.on_step_end(1, [])
    assert node.lost is not None
    assert node.lost.exit_code == 75


def test_asha_stops_the_bad_ones_and_a_stop_request_is_resumable(
    make_space: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = make_space(
        parameters={"shac.actor_lr": {"grid": [1e-2, 3e-3, 3e-4, 2e-4]}},
        scheduler={"kind": "asha", "grace": 0.2, "reduction": 2},
        overrides={"trial.epochs": 60},
    )
    path = tmp_path / "runs" / "asha"
    timer = threading.Thread(target=_terminate_when, args=(path,))
    timer.start()
    completed, records = go(space, path)
    timer.join()
    assert not completed
    assert None in outcomes(records)
    completed, records = go(space, path, resume=True)
    assert completed
    assert outcomes(records)[0] == "finished"
    assert "stopped_asha" in outcomes(records)
    stopped = next(record for record in records if str(record.ending and record.ending.outcome) == "stopped_asha")
    assert stopped.epochs_done < 60
    assert read_rows(records[0].folder)[-1]["epoch"] == 60
    assert "SIGTERM: " in capsys.readouterr().out
    assert go(space, path, resume=True)[0]  # nothing left to do


def test_population_stays_in_its_range(make_space: Any, tmp_path: Path) -> None:
    space = make_space(
        parameters={"shac.actor_lr": {"loguniform": [1e-4, 1e-2]}},
        samples=2,
        scheduler={"kind": "pbt", "interval": 0.3, "quantile": 0.5},
        # Twelve seconds: members must meet, however far apart a busy machine starts their processes.
        overrides={"evaluation.interval": 100, "trial.epochs": 600},
    )
    completed, records = go(space, tmp_path / "runs" / "pbt")
    assert completed
    assert outcomes(records) == ["finished"] * 2
    before = [record.trial.config.shac.actor_lr for record in records]
    after = [read_yaml(record.folder / "config.yaml")["shac"]["actor_lr"] for record in records]
    assert before != after  # the worse one moved
    assert all(1e-4 <= rate <= 1e-2 for rate in after)


def test_optuna_trials_enter_the_manifest(make_space: Any, tmp_path: Path) -> None:
    pytest.importorskip("optuna")
    space = make_space(
        parameters={"shac.actor_lr": {"loguniform": [1e-3, 1e-2]}, "shac.horizon": {"choice": [8, 16]}},
        samples=3,
        search="optuna",
        overrides={"trial.epochs": 4},
    )
    completed, records = go(space, tmp_path / "runs" / "optuna")
    assert completed
    assert len(records) >= 2
    assert set(outcomes(records)) == {"finished"}


def test_optuna_goes_on_where_it_was(make_space: Any, tmp_path: Path) -> None:
    pytest.importorskip("optuna")
    space = make_space(
        parameters={"shac.actor_lr": {"loguniform": [1e-3, 1e-2]}, "shac.horizon": {"choice": [8, 16]}},
        samples=3,
        search="optuna",
        overrides={"trial.epochs": 100},
    )
    path = tmp_path / "runs" / "optuna"
    timer = threading.Thread(target=_terminate_when, args=(path,))
    timer.start()
    completed, before = go(space, path)
    timer.join()
    assert not completed
    assert None in outcomes(before)
    # As after a driver that was killed: the manifest does not know the trials yet.
    Experiment(path).set_trials([])
    completed, after = go(space, path, resume=True)
    assert completed
    assert outcomes(after) == ["finished"] * 3
    # Those that had begun went on, from their checkpoints, and the others are new.
    ids = [record.trial.id for record in after]
    assert ids[: len(before)] == [record.trial.id for record in before]
    assert len(set(ids)) == 3
    assert [record.trial.index for record in after] == [0, 1, 2]
    assert "continuing from" in (before[0].folder / "output.log").read_text()
    assert all([row["epoch"] for row in read_rows(record.folder)] == list(range(101)) for record in after)
    with pytest.raises(StorageError, match="no longer gives the trial of"):
        recover(Experiment(path), make_space(parameters={"shac.actor_lr": {"loguniform": [1e-3, 1e-2]}}))


def test_a_population_goes_on_where_it_was(make_space: Any, tmp_path: Path) -> None:
    space = make_space(
        parameters={"shac.actor_lr": {"loguniform": [1e-4, 1e-2]}},
        samples=2,
        scheduler={"kind": "pbt", "interval": 0.6, "quantile": 0.5},
        overrides={"evaluation.interval": 20, "trial.epochs": 100},
    )
    path = tmp_path / "runs" / "pbt"
    timer = threading.Thread(target=_terminate_when, args=(path,))
    timer.start()
    completed, before = go(space, path)
    timer.join()
    assert not completed
    reached = [record.epochs_done for record in before]
    completed, after = go(space, path, resume=True)
    assert completed
    assert outcomes(after) == ["finished"] * 2
    assert max(reached) > 0
    for record in after:
        assert [row["epoch"] for row in read_rows(record.folder)] == list(range(101))
        assert 1e-4 <= read_yaml(record.folder / "config.yaml")["shac"]["actor_lr"] <= 1e-2


def test_processes_that_cannot_be_started_ahead_are_said_once_and_cost_no_trial(
    make_space: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def absent(*args: Any) -> None:
        raise AttributeError("no such call in this Ray")

    monkeypatch.setattr(worker_prestart, "start_processes", absent)
    space = make_space(parameters={}, seeds="0-2", overrides={"trial.epochs": 30})
    trials = resolve_trials(space)
    experiment = opening.create(tmp_path / "runs" / "alone", space, trials, {})
    assert driver.run_trials(driver.Plan(experiment, space, trials, Placement(0.0, 1), 1, StubTrainer, precompile=None))
    assert outcomes(read_records(experiment)) == ["finished"] * 3
    shown = capsys.readouterr().out
    assert (
        shown.count(
            "no process was started ahead of time, so trials start a few seconds later: AttributeError: no such call"
        )
        == 1
    )


def test_no_more_at_once_than_asked_for_and_the_next_process_waits(
    make_space: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = tmp_path / "go_on"

    class Patient(StubTrainer):
        """Its first trial does not end before a process for the next one waits."""

        def run_epoch(self) -> dict[str, float]:
            row = super().run_epoch()
            if self.config.trial.seed == 0 and self.finished:
                deadline = time.monotonic() + 120
                while not go_on.exists():
                    assert time.monotonic() < deadline
                    time.sleep(0.05)
            return row

    seen: set[int] = set()
    others: list[set[int]] = []
    start = worker_prestart.start_processes

    def start_and_tell(*args: Any) -> None:
        others.append(set(_processes_of_trials()))
        start(*args)

    monkeypatch.setattr(worker_prestart, "start_processes", start_and_tell)

    def watch() -> None:
        deadline = time.monotonic() + 100
        while not (others and seen - others[0]) and time.monotonic() < deadline:
            seen.update(_processes_of_trials() if others else ())
            time.sleep(0.1)
        go_on.touch()
        # More than one may wait, and Ray chooses: all that are there before the first trial has ended count.
        ended = experiment.trial_folder(trials[0].id) / "outcome.json"
        while not ended.exists() and time.monotonic() < deadline:
            seen.update(_processes_of_trials())

    space = make_space(parameters={}, seeds="0-1", overrides={"trial.epochs": 400})
    path = tmp_path / "runs" / "patient"
    trials = resolve_trials(space)
    experiment = opening.create(path, space, trials, {})
    thread = threading.Thread(target=watch)
    thread.start()
    assert driver.run_trials(driver.Plan(experiment, space, trials, Placement(0.0, 1), 1, Patient, precompile=None))
    thread.join()
    first, second = sorted(read_records(experiment), key=lambda record: record.trial.seed)
    assert outcomes([first, second]) == ["finished", "finished"]
    began = [json.loads((record.folder / "device.json").read_text()) for record in (first, second)]
    assert began[1]["began"] >= (first.folder / "outcome.json").stat().st_mtime
    assert began[0]["pid"] != began[1]["pid"]
    assert began[1]["pid"] in seen  # it was there before the trial before it had ended


def _processes_of_trials() -> list[int]:
    """Processes of this Ray that have the environment of trials."""

    def parent(pid: int) -> int:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])

    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):  # gone since it was listed
            text = path.read_bytes()
            pid = int(path.parent.name)
            if b"PL_DISABLE_FORK" in text and parent(parent(pid)) == os.getpid():
                found.append(pid)
    return found


def _terminate_when(path: Path) -> None:
    """SIGTERM to this process once a trial has begun to train."""
    while not list(path.glob("trials/*/checkpoints/epoch_000004.pt")):
        if (path / "summary.json").exists():
            return  # the sweep has ended without it
        time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGTERM)
