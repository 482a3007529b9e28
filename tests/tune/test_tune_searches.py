"""Real Ray, a trainer of milliseconds: rules, searches and populations that pause and resume, and their processes."""

import contextlib
import json
import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from stub_runs import go, interrupted, outcomes
from stub_trainer import (
    StubTrainer,
)

from msk_ray.config import read_yaml
from msk_ray.errors import StorageError
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.records import read_records
from msk_ray.sweep import opening
from msk_ray.sweep.search.tpe import OptunaSearch
from msk_ray.sweep.search_trials import recover
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune import driver, worker_prestart
from msk_ray.tune.devices import Placement

pytestmark = [pytest.mark.usefixtures("stub_session"), pytest.mark.long]


def test_asha_stops_the_bad_ones_and_a_stop_request_is_resumable(
    make_space: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = make_space(
        parameters={"shac.actor_lr": {"grid": [1e-2, 3e-3, 3e-4, 2e-4]}},
        scheduler={"kind": "asha", "grace": 0.2, "reduction": 2},
        overrides={"trial.epochs": 60},
    )
    path = tmp_path / "runs" / "asha"
    records = interrupted(space, path)
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


def test_population_stays_in_its_range(make_space: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Members must meet, however far apart a busy machine starts their processes. Ray lets the worse one move only once
    # it has stored a checkpoint of the better one, and no number of evaluations says when: they go on until then. If
    # none moves, pytest's limit of time ends the test.
    monkeypatch.setattr(StubTrainer, "members", 2)
    monkeypatch.setattr(StubTrainer, "until_moved", True)
    # The range is narrower than the factors by which a move changes a value: only one that is held to it stays inside.
    low, high = 1e-3, 1.1e-3
    space = make_space(
        parameters={"shac.actor_lr": {"loguniform": [low, high]}},
        samples=2,
        scheduler={"kind": "pbt", "interval": 1e-4, "quantile": 0.5, "resample": 0.0},
        overrides={"evaluation.interval": 100, "execution.checkpoint_interval": 1000, "trial.epochs": 1_000_000},
    )
    completed, records = go(space, tmp_path / "runs" / "pbt")
    assert completed
    assert outcomes(records) == ["finished"] * 2
    before = [record.trial.config.shac.actor_lr for record in records]
    after = [read_yaml(record.folder / "config.yaml")["shac"]["actor_lr"] for record in records]
    assert before != after  # the worse one moved
    assert all(low <= rate <= high for rate in after)


def test_optuna_trials_enter_the_manifest(make_space: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("optuna")
    space = make_space(
        parameters={"shac.actor_lr": {"loguniform": [1e-3, 1e-2]}, "shac.horizon": {"choice": [8, 16]}},
        samples=3,
        search="optuna",
        objectives={"eval/score": "maximize", "seconds": "minimize"},
        overrides={"trial.epochs": 4},
    )
    told: list[Any] = []
    own = OptunaSearch.tell_objectives

    def tell(self: OptunaSearch, params: Any, values: Any) -> None:
        told.append(values)
        own(self, params, values)

    monkeypatch.setattr(OptunaSearch, "tell_objectives", tell)
    completed, records = go(space, tmp_path / "runs" / "optuna")
    assert completed
    assert len(records) >= 2
    assert set(outcomes(records)) == {"finished"}
    last = [read_rows(record.folder)[-1] for record in records]
    assert sorted(told) == sorted((row["eval/score"], row["seconds"]) for row in last)


def test_optuna_goes_on_where_it_was(make_space: Any, tmp_path: Path) -> None:
    pytest.importorskip("optuna")
    space = make_space(
        parameters={"shac.actor_lr": {"loguniform": [1e-3, 1e-2]}, "shac.horizon": {"choice": [8, 16]}},
        samples=3,
        search="optuna",
        overrides={"trial.epochs": 100},
    )
    path = tmp_path / "runs" / "optuna"
    before = interrupted(space, path)
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
    before = interrupted(space, path)
    reached = [record.epochs_done for record in before]
    completed, after = go(space, path, resume=True)
    assert completed
    assert outcomes(after) == ["finished"] * 2
    assert max(reached) > 0
    for record in after:
        assert [row["epoch"] for row in read_rows(record.folder)] == list(range(101))
        assert 1e-4 <= read_yaml(record.folder / "config.yaml")["shac"]["actor_lr"] <= 1e-2


def test_processes_that_cannot_be_started_ahead_are_said_once_and_cost_no_trial(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def absent() -> None:
        raise AttributeError("no such call in this Ray")

    monkeypatch.setattr(worker_prestart, "_environment_of_trials", absent)
    said: list[str] = []
    callback = worker_prestart.WorkerPrestart(Placement(0.0, 1), 1, lambda: 2, said.append)
    for number in range(3):
        callback.on_trial_start(number, [], None)
        callback.on_trial_result(number, [], None, {})
    why = "AttributeError: no such call in this Ray"
    assert said == [f"no process was started ahead of time, so trials start a few seconds later: {why}"]


def test_no_more_at_once_than_asked_for_and_the_next_process_waits(
    make_space: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = tmp_path / "go_on"

    class Patient(StubTrainer):
        """Its first trial does not end before a process for the next one waits, which results bring about."""

        def run_epoch(self) -> dict[str, float]:
            row = super().run_epoch()
            if self.config.trial.seed == 0 and not go_on.exists():
                time.sleep(1.0)
            return row

    seen: set[int] = set()
    others: list[set[int]] = []
    start = worker_prestart.start_processes

    def start_and_tell(*args: Any) -> None:
        others.append(set(_processes_of_trials()))
        start(*args)

    monkeypatch.setattr(worker_prestart, "start_processes", start_and_tell)

    def watch() -> None:
        deadline = time.monotonic() + 450
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

    pids = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):  # gone since it was listed
            text = path.read_bytes()
            pid = int(path.parent.name)
            if b"PL_DISABLE_FORK" in text and parent(parent(pid)) == os.getpid():
                pids.append(pid)
    return pids
