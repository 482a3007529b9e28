"""The trainer: learns, resumes exactly, refuses what does not fit."""

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from needs import slow
from processes import Launcher, catches, wait_until

from msk_ray.cli import run
from msk_ray.config import Config, parse_config
from msk_ray.errors import CheckpointError, StorageFailure
from msk_ray.experiment.checkpoint_format import read_facts
from msk_ray.train import main
from msk_ray.training import Trainer, precompile, read_metrics
from msk_ray.training.checkpoint import epoch_checkpoints, milestones, read_checkpoint, write_checkpoint
from msk_ray.training.evaluation import Evaluator


def comparable(rows: list[dict]) -> list[dict]:
    """Rows without wall-clock figures."""
    timed = ("seconds", "env_steps_per_s")
    return [{k: v for k, v in row.items() if k not in timed and not k.startswith("time/")} for row in rows]


def train(config: Config, folder: Path) -> list[dict]:
    trainer = Trainer(config, folder, "cpu")
    while not trainer.finished:
        trainer.run_epoch()
    trainer.close()
    return read_metrics(folder / "metrics.jsonl")


def test_a_trial_leaves_its_record(tiny_cartpole: Config, tmp_path: Path) -> None:
    rows = train(tiny_cartpole, tmp_path)
    assert [row["epoch"] for row in rows] == list(range(7))
    assert [row["epoch"] for row in rows if "eval/score" in row] == [0, 2, 4, 6]
    assert rows[-1]["env_steps"] == 6 * 8 * 8
    assert rows[-1]["eval/best_score"] == max(row["eval/score"] for row in rows[1:] if "eval/score" in row)
    assert [p.name for p in epoch_checkpoints(tmp_path / "checkpoints")] == ["epoch_000006.pt", "epoch_000004.pt"]
    assert (tmp_path / "checkpoints" / "best.pt").is_file()
    assert list(tmp_path.glob("events*"))
    assert yaml.safe_load((tmp_path / "config.yaml").read_text()) == tiny_cartpole.as_dict()


def test_the_untrained_policy_is_kept_without_a_score_until_a_trained_one_has_one(
    tiny_cartpole: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here training makes it worse: 0 untrained, then -2, -4 and -6."""
    monkeypatch.setattr(Evaluator, "run", lambda self, policies: [{"score": -float(trainer.epoch)}])
    trainer = Trainer(tiny_cartpole, tmp_path, "cpu")
    trainer.run_epoch()
    assert trainer.best_score == -math.inf
    facts = read_facts(trainer.best_checkpoint)
    assert (facts["epoch"], facts["best_score"]) == (0, None)
    while not trainer.finished:
        trainer.run_epoch()
    trainer.close()
    facts = read_facts(trainer.best_checkpoint)
    assert (facts["epoch"], facts["best_score"]) == (2, -2.0)
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert [row.get("eval/best_score") for row in rows] == [None, None, -2.0, None, -2.0, None, -2.0]


def test_a_trial_can_start_from_another_ones_networks(tiny_cartpole: Config, tmp_path: Path) -> None:
    train(tiny_cartpole, tmp_path / "first")
    best = tmp_path / "first" / "checkpoints" / "best.pt"
    score = max(row.get("eval/score", -math.inf) for row in read_metrics(tmp_path / "first" / "metrics.jsonl"))
    settings = tiny_cartpole.as_dict()
    settings["trial"]["start_from"] = str(best)
    second = Trainer(Config.model_validate(settings), tmp_path / "second", "cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        second.run_epoch()
    second.close()
    initial = read_metrics(tmp_path / "second" / "metrics.jsonl")[0]
    assert initial["epoch"] == 0
    assert initial["env_steps"] == 0
    assert initial["eval/score"] == pytest.approx(score)


def test_a_policy_saved_alone_is_enough_to_start_from(tiny_cartpole: Config, tmp_path: Path) -> None:
    train(tiny_cartpole, tmp_path / "first")
    _, policy = milestones(tmp_path / "first" / "checkpoints")[-1]
    settings = tiny_cartpole.as_dict()
    settings["trial"]["start_from"] = str(policy)
    second = Trainer(Config.model_validate(settings), tmp_path / "second", "cpu")
    with pytest.warns(UserWarning, match="has no critic and no target_critic, which begin untrained"):
        second.run_epoch()
    second.close()
    last = read_metrics(tmp_path / "first" / "metrics.jsonl")[-1]
    assert read_metrics(tmp_path / "second" / "metrics.jsonl")[0]["eval/score"] == pytest.approx(last["eval/score"])


@pytest.mark.parametrize("missing", [True, False])
def test_a_checkpoint_that_does_not_fit_is_no_start(tiny_cartpole: Config, tmp_path: Path, missing: bool) -> None:
    settings = tiny_cartpole.as_dict()
    settings["trial"]["start_from"] = str(tmp_path / "first" / "checkpoints" / "best.pt")
    if not missing:
        train(tiny_cartpole, tmp_path / "first")
        settings["actor"]["hidden"] = [9]
    trainer = Trainer(Config.model_validate(settings), tmp_path / "second", "cpu")
    with pytest.raises(CheckpointError, match="no such checkpoint" if missing else "does not fit this trial"):
        trainer.run_epoch()
    trainer.close()


def test_resuming_gives_the_metrics_of_an_uninterrupted_run(tiny_cartpole: Config, tmp_path: Path) -> None:
    whole = train(tiny_cartpole, tmp_path / "whole")
    first = Trainer(tiny_cartpole, tmp_path / "cut", "cpu")
    for _ in range(5):  # the newest checkpoint is of epoch 4; epoch 5 is lost and done again
        first.run_epoch()
    first.close()
    second = Trainer(tiny_cartpole, tmp_path / "cut", "cpu")
    path, faults = second.restore_latest()
    assert path is not None
    assert path.name == "epoch_000004.pt"
    assert not faults
    while not second.finished:
        second.run_epoch()
    second.close()
    assert comparable(read_metrics(tmp_path / "cut" / "metrics.jsonl")) == comparable(whole)


def command_of(config: dict[str, Any], tmp_path: Path, logdir: str) -> list[str]:
    """`python -m msk_ray.train` of a config, on the CPU."""
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    return [
        sys.executable, "-m", "msk_ray.train", "--config", str(tmp_path / "config.yaml"), "--device", "cpu",
        "--logdir", str(tmp_path / logdir),
    ]  # fmt: skip


def rows_in(metrics: Path) -> int:
    return len(metrics.read_text().splitlines()) if metrics.exists() else 0


@pytest.mark.long
def test_killing_the_train_command_loses_nothing(
    root: Path, tiny_cartpole: Config, tmp_path: Path, launcher: Launcher
) -> None:
    config = tiny_cartpole.as_dict()
    config["trial"] |= {"epochs": 40}
    whole = train(Config.model_validate(config), tmp_path / "whole")
    command = command_of(config, tmp_path, "killed")
    process = launcher.start(command, cwd=root, stdout=subprocess.DEVNULL)
    metrics = tmp_path / "killed" / "metrics.jsonl"
    wait_until(lambda: rows_in(metrics) > 12, process)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert len(read_metrics(metrics)) < 41
    assert run(main, [*command[3:], "--resume"]) == 0
    assert comparable(read_metrics(metrics)) == comparable(whole)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, *slow(signal.SIGUSR1, signal.SIGHUP)])
def test_a_signal_saves_and_says_resumable(
    number: signal.Signals, root: Path, tiny_cartpole: Config, tmp_path: Path, launcher: Launcher
) -> None:
    config = tiny_cartpole.as_dict()
    config["trial"] |= {"epochs": 100000}
    config["execution"] |= {"checkpoint_interval": 100000}
    process = launcher.start(command_of(config, tmp_path, "run"), cwd=root, stdout=subprocess.PIPE)
    metrics = tmp_path / "run" / "metrics.jsonl"
    wait_until(lambda: rows_in(metrics) > 3, process)
    if number is signal.SIGHUP:
        process.stdout.close()  # the reader disappears with the terminal
        process.send_signal(number)
        assert process.wait() == 75
        output = (tmp_path / "run" / "terminal.log").read_text()
    else:
        process.send_signal(number)
        output, _ = process.communicate()
        assert process.returncode == 75
    assert f"stopped by {number.name}" in output
    assert f"continue with: python -m msk_ray.train --config {tmp_path / 'config.yaml'}" in output
    assert output.rstrip().endswith("--resume")
    assert len(epoch_checkpoints(tmp_path / "run" / "checkpoints")) == 1
    rows = [json.loads(line) for line in metrics.read_text().splitlines()]
    assert f"epoch_{rows[-1]['epoch']:06d}.pt" == epoch_checkpoints(tmp_path / "run" / "checkpoints")[0].name


def test_a_folder_that_was_moved_stops_training_resumably_and_is_not_made_again(
    tiny_cartpole: Config, tmp_path: Path
) -> None:
    whole = train(tiny_cartpole, tmp_path / "whole")
    folder = tmp_path / "run"
    first = Trainer(tiny_cartpole, folder, "cpu")
    for _ in range(3):
        first.run_epoch()
    folder.rename(tmp_path / "elsewhere")
    with pytest.raises(StorageFailure, match="No such file or directory") as caught:
        first.run_epoch()
    assert caught.value.exit_code == 75
    with contextlib.suppress(StorageFailure):  # TensorBoard's thread may have events left to write, or none
        first.close()
    assert not folder.exists()
    (tmp_path / "elsewhere").rename(folder)
    second = Trainer(tiny_cartpole, folder, "cpu")
    assert second.restore_latest()[0] == folder / "checkpoints" / "epoch_000002.pt"
    while not second.finished:
        second.run_epoch()
    second.close()
    assert comparable(read_metrics(folder / "metrics.jsonl")) == comparable(whole)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP])
def test_a_signal_before_training_is_a_request_to_stop_too(
    number: signal.Signals, root: Path, tiny_cartpole: Config, tmp_path: Path, launcher: Launcher
) -> None:
    command = command_of(tiny_cartpole.as_dict(), tmp_path, "run")
    process = launcher.start(command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    wait_until(lambda: catches(process.pid, signal.SIGHUP), process)  # the last one it listens to
    process.send_signal(number)
    _, errors = process.communicate()
    assert process.returncode == 75
    assert errors.startswith(f"stopped by {number.name}")


def test_a_checkpoint_of_other_settings_is_refused(tiny_cartpole: Config, tmp_path: Path) -> None:
    train(tiny_cartpole, tmp_path / "a")
    other = tiny_cartpole.as_dict()
    other["shac"]["gamma"] = 0.9
    trainer = Trainer(Config.model_validate(other), tmp_path / "b", "cpu")
    with pytest.raises(CheckpointError, match=r"shac\.gamma was 0\.99, now 0\.9"):
        trainer.restore(tmp_path / "a" / "checkpoints" / "best.pt")


@pytest.mark.parametrize(
    ("section", "key", "value", "message"),
    [("trial", "epochs", 3, "has 6 epochs already: set trial.epochs to the new total, not 3"),
     ("env", "nworld", 16, r"env\.nworld was \d+, now 16")],
)  # fmt: skip
def test_a_refused_resume_leaves_the_record_as_it_was(
    section: str, key: str, value: int, message: str, tiny_cartpole: Config, tmp_path: Path
) -> None:
    train(tiny_cartpole, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    other = tiny_cartpole.as_dict()
    other[section][key] = value
    trainer = Trainer(Config.model_validate(other), tmp_path, "cpu")
    with pytest.raises(CheckpointError, match=message):
        trainer.restore_latest()
    assert {path: path.read_bytes() for path in before if "tfevents" not in path.name} == {
        path: data for path, data in before.items() if "tfevents" not in path.name
    }


def test_a_resume_with_more_epochs_is_recorded(tiny_cartpole: Config, tmp_path: Path) -> None:
    train(tiny_cartpole, tmp_path)
    more = tiny_cartpole.as_dict()
    more["trial"]["epochs"] = 8
    trainer = Trainer(Config.model_validate(more), tmp_path, "cpu")
    trainer.restore_latest()
    trainer.close()
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["trial"]["epochs"] == 8


def test_a_checkpoint_of_a_gpu_is_refused_on_a_cpu(tiny_cartpole: Config, tmp_path: Path) -> None:
    """The state of a generator has 16 bytes on a GPU and 5056 on a CPU."""
    train(tiny_cartpole, tmp_path)
    path = epoch_checkpoints(tmp_path / "checkpoints")[0]
    state = read_checkpoint(path)
    state["algorithm"]["env_generator"] = torch.zeros(16, dtype=torch.uint8)
    write_checkpoint(path, state, {"epoch": state["epoch"]})
    with pytest.raises(CheckpointError, match=r"on a GPU.*--device cuda:0.*trial\.start_from=.*epoch_000006\.pt"):
        Trainer(tiny_cartpole, tmp_path, "cpu").restore(path)


def test_a_torn_checkpoint_falls_back_to_the_one_before(tiny_cartpole: Config, tmp_path: Path) -> None:
    whole = train(tiny_cartpole, tmp_path)
    newest = epoch_checkpoints(tmp_path / "checkpoints")[0]
    newest.write_bytes(newest.read_bytes()[:100])
    trainer = Trainer(tiny_cartpole, tmp_path, "cpu")
    path, faults = trainer.restore_latest()
    assert path is not None
    assert path.name == "epoch_000004.pt"
    assert "epoch_000006.pt is torn" in faults[0]
    while not trainer.finished:
        trainer.run_epoch()
    trainer.close()
    assert comparable(read_metrics(tmp_path / "metrics.jsonl")) == comparable(whole)


def test_room_may_change_and_is_kept_in_checkpoints(tiny_settings: dict[str, Any], tmp_path: Path) -> None:
    """An error that asks for execution.njmax can be followed; room that grew is there from the first step on."""
    tiny_settings["env"] = {"name": "ant", "nworld": 2, "episode_length": 4}
    tiny_settings["shac"] |= {"horizon": 2}
    tiny_settings["execution"] |= {"nconmax": 30}
    first = Trainer(parse_config(tiny_settings), tmp_path, "cpu")
    first.run_epoch()
    path = first.save()
    first.close()
    tiny_settings["execution"] |= {"nconmax": None, "njmax": 100}
    second = Trainer(parse_config(tiny_settings), tmp_path, "cpu")
    second.env.sim.reserve = (asked := []).append
    second.restore(path)
    second.close()
    assert asked == [(30, first.env.sim.capacity.rows)]
    tiny_settings["physics"] = {"tolerance": 1e-5}
    third = Trainer(parse_config(tiny_settings), tmp_path, "cpu")
    with pytest.raises(CheckpointError, match=r"physics\.tolerance"):
        third.restore(path)
    third.close()


def test_kernels_are_compiled_in_few_worlds(tiny_settings: dict[str, Any], tmp_path: Path) -> None:
    huge = tiny_settings | {"env": tiny_settings["env"] | {"nworld": 2**31 - 1}}
    huge["evaluation"] = tiny_settings["evaluation"] | {"nworld": 2**31 - 1}
    precompile(Config.model_validate(huge), "cpu", tmp_path)  # no machine has room for so many
