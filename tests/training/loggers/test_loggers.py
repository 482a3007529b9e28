"""Where rows go: first to metrics.jsonl, then to every logger, ours in the real packages' own files."""

import errno
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from tensorboard.compat.proto.event_pb2 import SessionLog

import msk_ray.train as train_command
from msk_ray.config import Config, dump_yaml, load_config, parse_config
from msk_ray.errors import ConfigError, LoggerError, SimulationError, StorageFailure
from msk_ray.experiment.metrics import read_metrics
from msk_ray.training import Trainer, precompile
from msk_ray.training.loggers import TrialLog
from msk_ray.training.loggers.tensorboard import board_tag

pytestmark = pytest.mark.long

OUTSIDE = """
from msk_ray import Logger
class Heard(Logger):
    calls = []
    def write(self, row): self.calls.append(("write", row))
    def config(self, settings): self.calls.append(("config", settings["env"]["name"]))
    def rewind(self, epoch): self.calls.append(("rewind", epoch))
    def close(self): self.calls.append(("close",))
class Broken(Heard):
    fault = ValueError("no such chart\\nmore")
    def write(self, row): raise self.fault
class Silent(Logger):
    pass
class NoLogger:
    def write(self, row): pass
"""


@pytest.fixture
def outside(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A module with loggers that the package does not know."""
    folder = tmp_path_factory.mktemp("outside")
    (folder / "loggers_outside.py").write_text(OUTSIDE)
    monkeypatch.syspath_prepend(folder)
    import loggers_outside

    yield loggers_outside
    del sys.modules["loggers_outside"]


def config(*loggers: str) -> Config:
    return parse_config({"env": {"name": "cartpole"}, "execution": {"loggers": list(loggers)}})


def row(epoch: int, **figures: float) -> dict[str, float]:
    return {"epoch": epoch, "env_steps": 8.0 * epoch, **figures}


def charts(folder: Path) -> dict[str, list[tuple[int, float]]]:
    events = EventAccumulator(str(folder)).Reload()
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_tensorboard_groups_by_what_a_figure_is_about(tmp_path: Path) -> None:
    assert board_tag("eval/score") == "eval/score"
    log = TrialLog(tmp_path, config("tensorboard"))
    log.write({"epoch": 3, "env_steps": 9.0, "train/actor_lr": 1e-3, "train/reward": 1.0, "eval/term/up": 2.0})
    log.close()
    expected = {"progress/env_steps": 9.0, "schedule/actor_lr": 1e-3, "train/reward": 1.0, "eval_terms/up": 2.0}
    found = charts(tmp_path)
    assert {tag: points[0][1] for tag, points in found.items()} == pytest.approx(expected)
    assert found["train/reward"][0][0] == 3


def test_tensorboard_hides_what_a_resumed_trial_does_again(tmp_path: Path) -> None:
    """The mark in the file from which on TensorBoard hides what older files say. Those of one second have no order."""
    log = TrialLog(tmp_path, config("tensorboard"))
    log.rewind(2)
    log.write(row(3, a=2.0))
    log.close()
    (file,) = tmp_path.glob("events*")
    marks = [event.step for event in EventFileLoader(str(file)).Load() if event.session_log.status == SessionLog.START]
    assert marks == [3]
    assert charts(tmp_path)["a"] == [(3, 2.0)]


def test_figures_known_later_are_added_to_their_row(tmp_path: Path) -> None:
    log = TrialLog(tmp_path, config("tensorboard"))
    assert log.takes_late
    for epoch in range(3):
        log.write(row(epoch, a=1.0, seconds=1.0))
    for epoch in (0, 2):
        log.write_late(row(epoch, a=1.0, seconds=1.0), {"eval/score": 10.0 * epoch, "eval/nothing": math.nan})
    log.close()
    found = charts(tmp_path)
    assert found["eval/score"] == [(0, 0.0), (2, 20.0)]
    assert [step for step, _ in found["a"]] == [0, 1, 2]
    assert "eval/nothing" not in found
    assert [r.get("eval/score") for r in read_metrics(tmp_path / "metrics.jsonl")] == [0.0, None, 20.0]
    assert all(r["a"] == 1.0 for r in read_metrics(tmp_path / "metrics.jsonl"))
    assert not TrialLog(tmp_path / "other", config("tensorboard", "wandb")).takes_late


def test_metrics_jsonl_is_written_without_any_logger(tmp_path: Path) -> None:
    log = TrialLog(tmp_path, config())
    log.write(row(0, a=math.nan))
    log.close()
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.jsonl"]
    assert [path.read_text() for path in tmp_path.iterdir()] == [
        '{"epoch": 0, "env_steps": 0.0, "a": null, "nonfinite": ["a"]}\n'
    ]


def test_a_logger_from_outside_hears_everything_in_order(outside: Any, tmp_path: Path) -> None:
    log = TrialLog(tmp_path, config("loggers_outside:Heard"))
    assert list(tmp_path.iterdir()) == []
    log.rewind(-1)
    log.write(row(0, a=1.0, b=math.inf))
    log.write(row(1, a=2.0))
    log.close()
    assert outside.Heard.calls == [
        ("rewind", -1), ("config", "cartpole"), ("write", row(0, a=1.0)), ("write", row(1, a=2.0)), ("close",),
    ]  # fmt: skip


def test_a_command_that_fails_closes_its_loggers(
    outside: Any, tiny_settings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_epoch = Trainer.run_epoch

    def fail_in_the_second(self: Trainer) -> dict[str, float]:
        if self.epoch == 1:
            raise SimulationError("made up")
        return run_epoch(self)

    monkeypatch.setattr(Trainer, "run_epoch", fail_in_the_second)
    (tmp_path / "tiny.yaml").write_text(dump_yaml(tiny_settings))
    settings = ["--set", "execution.loggers=[loggers_outside:Heard]", "--device", "cpu"]
    with pytest.raises(SimulationError, match="made up"):
        train_command.main(["--config", str(tmp_path / "tiny.yaml"), "--logdir", str(tmp_path / "trial"), *settings])
    assert [call[0] for call in outside.Heard.calls] == ["config", "write", "write", "close"]


def test_a_logger_that_fails_loses_no_row_and_is_named(outside: Any, tmp_path: Path) -> None:
    log = TrialLog(tmp_path, config("loggers_outside:Broken", "loggers_outside:Heard", "tensorboard"))
    expected = r"execution\.loggers: loggers_outside:Broken failed \(ValueError: no such chart\); the rows are in"
    with pytest.raises(LoggerError, match=expected) as caught:
        log.write(row(0, a=1.0))
    assert "\n" not in str(caught.value)
    assert ("write", row(0, a=1.0)) in outside.Heard.calls
    log.close()
    assert charts(tmp_path)["a"] == [(0, 1.0)]
    assert [r["a"] for r in read_metrics(tmp_path / "metrics.jsonl")] == [1.0]


@pytest.mark.parametrize(
    "fault",
    [OSError(errno.ENOSPC, "No space left on device"), FileNotFoundError(errno.ENOENT, "No such file", "/gone/rows")],
    ids=["full", "gone"],
)
def test_a_loggers_full_or_lost_disk_is_the_trials(outside: Any, tmp_path: Path, fault: OSError) -> None:
    outside.Broken.fault = fault
    log = TrialLog(tmp_path, config("loggers_outside:Broken"))
    with pytest.raises(StorageFailure, match="loggers_outside:Broken cannot write") as caught:
        log.write(row(0))
    assert caught.value.exit_code == 75
    assert len(read_metrics(tmp_path / "metrics.jsonl")) == 1


@pytest.mark.parametrize(
    ("loggers", "message"),
    [
        (["tensorbord"], "execution.loggers: unknown name 'tensorbord'; did you mean 'tensorboard'"),
        (["no_such_module:Log"], "execution.loggers: no module 'no_such_module'"),
        (["loggers_outside:Herd"], "did you mean 'Heard'"),
        (["loggers_outside:NoLogger"], "is not a subclass of msk_ray.training.loggers.base.Logger"),
        (["loggers_outside:Silent"], "loggers_outside:Silent lacks write"),
        (["tensorboard", "tensorboard"], "tensorboard is given twice"),
    ],
)
@pytest.mark.usefixtures("outside")
def test_faults_are_named_before_the_first_step(loggers: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        precompile(config(*loggers), "cpu", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_package_that_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("msk_ray.config.packages.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"package wandb, which is not installed: pip install 'msk-ray\[wandb\]'"):
        TrialLog(tmp_path, config("wandb"))


def test_loggers_may_change_when_a_trial_goes_on(tiny_settings: dict[str, Any], tmp_path: Path) -> None:
    first = Trainer(parse_config(tiny_settings), tmp_path, "cpu")
    for _ in range(2):
        first.run_epoch()
    first.close()
    tiny_settings = tiny_settings | {"execution": tiny_settings["execution"] | {"loggers": []}}
    second = Trainer(parse_config(tiny_settings), tmp_path, "cpu")
    assert second.restore_latest()[0] is not None
    second.run_epoch()
    second.close()
    assert max(step for step, _ in charts(tmp_path)["train/reward"]) == 2
    assert load_config(tmp_path / "config.yaml").execution.loggers == ()


def resumed(folder: Path, name: str) -> None:
    """Epochs 0 to 3, as a trial that died after epoch 2 and went on from epoch 1 writes them."""
    first = TrialLog(folder, config(name))
    for epoch in range(3):
        first.write(row(epoch, **{"eval/score": 10.0 * epoch}))
    first.close()
    second = TrialLog(folder, config(name))
    second.rewind(1)
    for epoch in (2, 3):
        second.write(row(epoch, **{"eval/score": 10.0 * epoch}))
    second.close()


def records(path: Path) -> Iterator[bytes]:
    """The records in a .wandb file: LevelDB's log format (blocks of 32 KiB; CRC, length, kind, data) after 7 bytes."""
    data, place, whole = path.read_bytes(), 7, b""
    while place + 7 <= len(data):
        if 32768 - place % 32768 < 7:
            place += 32768 - place % 32768
            continue
        length, kind = int.from_bytes(data[place + 4 : place + 6], "little"), data[place + 6]
        whole += data[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # full, or the last of several
            yield whole
            whole = b""


def test_weights_and_biases_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import wandb
    from wandb.proto.wandb_internal_pb2 import Record

    monkeypatch.setenv("WANDB_MODE", "offline")
    folder = tmp_path / "sweep" / "trials" / "0a1b2c3d"
    folder.mkdir(parents=True)
    resumed(folder, "wandb")
    wandb.teardown()
    rows, runs, settings = {}, set(), {}
    for path in sorted((folder / "wandb").glob("offline-run-*/*.wandb")):
        for data in records(path):
            record = Record.FromString(data)
            if record.HasField("run"):
                runs.add((record.run.run_group, record.run.display_name, record.run.run_id))
            changes = [*record.config.update, *record.run.config.update]
            settings |= {item.key or item.nested_key[0]: item.value_json for item in changes}
            if record.HasField("history"):
                kept = {i.key or i.nested_key[0]: json.loads(i.value_json) for i in record.history.item}
                rows[kept["_step"]] = kept["eval/score"]
    assert rows == {0: 0.0, 1: 10.0, 2: 20.0, 3: 30.0}
    assert len(runs) == 1, "a resumed trial is the same run"
    assert {run[:2] for run in runs} == {("sweep", "0a1b2c3d")}
    assert json.loads(settings["env"])["name"] == "cartpole"


def test_mlflow_in_a_local_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mlflow.tracking import MlflowClient

    store = f"sqlite:///{tmp_path / 'mlflow.db'}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", store)
    folder = tmp_path / "sweep" / "trials" / "0a1b2c3d"
    folder.mkdir(parents=True)
    resumed(folder, "mlflow")
    third = TrialLog(folder, config("mlflow"))
    third.rewind(3)
    third.write(row(4))
    third.write_late(row(3), {"eval/score": 31.0})  # it has a score already
    third.write_late(row(4), {"eval/score": 40.0})
    third.close()
    client = MlflowClient(store)
    (run,) = client.search_runs([client.get_experiment_by_name("sweep").experiment_id])
    assert (run.info.run_name, run.info.status) == ("0a1b2c3d", "FINISHED")
    assert run.data.params["env.name"] == "cartpole"
    history = client.get_metric_history(run.info.run_id, "eval/score")
    assert [(m.step, m.value) for m in history] == [(0, 0.0), (1, 10.0), (2, 20.0), (3, 30.0), (4, 40.0)]
