"""The command line without Ray: dry runs, and refusals that cost one line and no work."""

import bdb
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from msk_ray.cli import run
from msk_ray.config import dump_yaml, packages, read_yaml
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.outcomes import Ending, Outcome, write_ending
from msk_ray.signals import RESUMABLE
from msk_ray.sweep.rules.nonfinite import NonFinite
from msk_ray.sweep.rules.wall_time import WallTime
from msk_ray.tune import driver
from msk_ray.tune.__main__ import main
from msk_ray.tune.options import read_options


@pytest.fixture
def space_file(tmp_path: Path, space_data: dict[str, Any]) -> Path:
    path = tmp_path / "small.yaml"
    path.write_text(dump_yaml(space_data))
    return path


def test_dry_run_prints_the_trials(space_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(main, ["--space", str(space_file), "--dry-run", "--seeds", "3-4", "--set", "trial.epochs=7"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split() for line in lines if line[:1].isdigit() and "actor_lr" in line]
    assert [(row[0], row[2], row[3], row[4]) for row in rows] == [
        ("0", "actor_lr=0.01", "3", "7"),
        ("1", "actor_lr=0.001", "3", "7"),
        ("2", "actor_lr=0.01", "4", "7"),
        ("3", "actor_lr=0.001", "4", "7"),
    ]
    assert lines[-1].startswith("4 trials · scheduler none")


def test_dry_run_imports_neither_ray_nor_torch(space_file: Path, root: Path) -> None:
    code = (
        "import sys; from msk_ray.tune.__main__ import main; "
        f"main(['--space', {str(space_file)!r}, '--dry-run', '--smoke']); "
        "sys.exit(bool({'ray', 'torch'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=root, env={**os.environ, "PYTHONPATH": str(root)})
    assert result.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--space", "ant_abate"], "unknown space 'ant_abate'; known: "),
        (["--space", "nowhere/x.yaml"], "no such space file"),
        (["--space", "SPACE", "--set", "shac.gama=1"], "did you mean 'gamma'"),
        (["--space", "SPACE", "--set", "shac.gamma"], "write key=value"),
        (["--space", "SPACE", "--set", "shac.gamma=2"], "less than or equal to 1"),
        (["--space", "SPACE", "--set", "shac.actor_lr=1"], "the space varies it"),
        (["--space", "SPACE", "--set", "physics.timestep=0.005"], "does not divide"),
        (["--space", "SPACE", "--seeds", "x"], "whole numbers such as 0-4"),
        (["--space", "SPACE", "--max-concurrent", "0"], "at least 1"),
        (["--space", "SPACE", "--debug-trial", "7"], "no trial '7'"),
        (["--space", "SPACE", "--name", "a/b"], "letters, digits"),
        (["--space", "SPACE", "--resume"], "no experiment at"),
        (["--space", "SPACE", "--retry-errored"], "needs --resume"),
        (["--space", "SPACE", "--gpus-per-trial", "1", "--cpu"], "exclude each other"),
        (["--space", "SPACE", "--storage", "/proc/x"], "cannot write to"),
    ],
)
def test_malformed_input_is_one_line_and_exit_2(
    arguments: list[str],
    message: str,
    space_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert run(main, [str(space_file) if a == "SPACE" else a for a in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_one_gpu_a_trial_without_gpu(
    space_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("msk_ray.tune.devices.local_gpus", lambda: 0)
    assert run(main, ["--space", str(space_file), "--gpus-per-trial", "1"]) == 2
    assert capsys.readouterr().err == "error: --gpus-per-trial 1: there is no GPU; pass --cpu to run on CPUs\n"
    assert not (tmp_path / "runs").exists()


def test_help_teaches_with_examples(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert text.count("python -m msk_ray.tune --space") >= 6
    assert "exit codes" in text


def test_every_trial_to_its_end_on_request(
    space_data: dict[str, Any], tmp_path: Path, plans: list[driver.Plan], capsys: pytest.CaptureFixture[str]
) -> None:
    """What ends trials by score is left out, what ends broken ones is not; --resume remembers."""
    space = tmp_path / "small.yaml"
    stop = {"target": 9.0, "plateau": {"patience": 2}, "wall_time_s": 60.0}
    space.write_text(dump_yaml(space_data | {"scheduler": {"kind": "asha"}, "stop": stop}))

    def early(*arguments: str) -> bool:
        code = run(main, ["--space", str(space), "--cpu", "--storage", str(tmp_path / "runs"), *arguments])
        assert code == RESUMABLE
        file = plans.pop().space.file
        assert (file.stop.nonfinite, file.stop.wall_time_s) == (NonFinite(), WallTime(seconds=60.0))
        by_score = {file.scheduler.kind != "none", file.stop.plateau is not None, file.stop.target is not None}
        assert len(by_score) == 1, "all of them or none"
        return by_score.pop()

    def recorded() -> Any:
        return read_yaml(tmp_path / "runs" / "small" / "space.yaml")["scheduler"]["kind"]

    assert not early("--no-early-stopping")
    assert recorded() == "none"
    assert not early("--resume")
    made = Experiment(tmp_path / "runs" / "small")
    made.trial_folder(made.trials()[0].id).mkdir()
    write_ending(made.trial_folder(made.trials()[0].id), Ending(Outcome.STOPPED_ASHA, "behind"))
    assert early("--resume", "--early-stopping")
    assert recorded() == "asha"
    assert early("--resume")
    capsys.readouterr()
    assert not early("--resume", "--no-early-stopping")
    assert "still stopped early: 1 trials; --retry stopped_asha lets them continue" in capsys.readouterr().out
    facts = json.loads((made.path / "env.json").read_text())
    (made.path / "env.json").write_text(json.dumps(facts | {"command": ["msk-ray", "tune", "--no-early-stopping"]}))
    here = tmp_path / "runs"
    assert made.resume_command() == f"msk-ray tune --storage {here} --resume", "not what would undo a later word"
    for words, now in (
        (["--storage", "/elsewhere"], f"--storage {here}"),
        ([f"--storage={here}/../runs"], f"--storage={here}/../runs"),
    ):
        (made.path / "env.json").write_text(json.dumps(facts | {"command": ["msk-ray", "tune", *words]}))
        assert made.resume_command() == f"msk-ray tune {now} --resume", "where it has been moved to"
    assert early("--resume", "--early-stopping")
    assert early("--name", "other")
    assert run(main, ["--space", str(space), "--cpu", "--smoke", "--early-stopping"]) == 2
    assert "a smoke run does not end trials by their score" in capsys.readouterr().err
    space.write_text(dump_yaml(space_data | {"scheduler": {"kind": "pbt"}, **drawn_rate()}))
    assert run(main, ["--space", str(space), "--dry-run", "--no-early-stopping"]) == 2
    assert "in small.yaml trials continue from each other (pbt)" in capsys.readouterr().err


def test_start_or_resume_asks_the_experiment_by_the_name_it_has(
    space_file: Path, tmp_path: Path, plans: list[driver.Plan], capsys: pytest.CaptureFixture[str]
) -> None:
    """As a scheduler does that knows nothing of what it started before."""
    command = ["--space", str(space_file), "--cpu", "--storage", str(tmp_path / "runs"), "--start-or-resume"]
    for name in (["--name", "other"], ["--na=third"], ["--smoke"], []):
        made = []
        for _ in range(2):
            assert run(main, [*command, *name]) == RESUMABLE
            made.append((plans[-1].experiment.path / "manifest.json").read_text())
        assert json.loads(made[0])["created"] == json.loads(made[1])["created"]
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == ["other", "small", "small-smoke", "third"]
    (tmp_path / "runs" / "small" / "manifest.json").unlink()  # killed before it was whole
    assert run(main, command) == RESUMABLE


def test_another_rule_is_refused(
    space_data: dict[str, Any], tmp_path: Path, plans: list[driver.Plan], capsys: pytest.CaptureFixture[str]
) -> None:
    """Trials that one rule has stopped do not continue beside others under another; a new default is no new rule."""
    space = tmp_path / "small.yaml"
    space.write_text(dump_yaml(space_data | {"scheduler": {"kind": "asha"}}))
    arguments = ["--space", str(space), "--cpu", "--storage", str(tmp_path / "runs")]
    assert run(main, arguments) == RESUMABLE
    kept = read_yaml(tmp_path / "runs" / "small" / "space.yaml")["scheduler"]
    assert (kept["grace"], kept["reduction"]) == (0.25, 3.0), "in full"
    space.write_text(dump_yaml(space_data | {"scheduler": {"kind": "asha", "grace": 0.1}}))
    manifest = (tmp_path / "runs" / "small" / "manifest.json").read_text()
    assert run(main, [*arguments, "--resume"]) != 0
    assert "grace 0.25 → 0.1" in capsys.readouterr().err
    assert (tmp_path / "runs" / "small" / "manifest.json").read_text() == manifest
    space.write_text(dump_yaml(space_data | {"scheduler": {"kind": "asha", "grace": 0.25}}))
    assert run(main, [*arguments, "--resume"]) == RESUMABLE
    assert "is not known" not in capsys.readouterr().out
    assert len(plans) == 2
    (tmp_path / "runs" / "small" / "space.yaml").unlink()
    assert run(main, [*arguments, "--resume"]) == RESUMABLE
    assert "is still the one that stopped trials" in capsys.readouterr().out


def drawn_rate() -> dict[str, Any]:
    """What pbt can exchange."""
    return {"parameters": {"shac.actor_lr": {"loguniform": [1e-4, 1e-2]}}, "samples": 4}


@pytest.mark.parametrize("setting", ["search", "algorithm", "logger", "model"])
def test_a_missing_package_is_named_by_a_dry_run_and_before_ray_starts(
    setting: str,
    space_data: dict[str, Any],
    tmp_path: Path,
    plans: list[driver.Plan],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    changes, message = {
        "search": (
            {"search": "optuna", **drawn_rate()},
            "search: optuna needs the package optuna, .*'msk-ray[optuna]'",
        ),
        "algorithm": (
            {"parameters": {"ppo.lr": {"grid": [0.1, 0.01]}}, "overrides": {"algorithm.name": "ppo"}},
            "algorithm.name: ppo needs the package rsl_rl, .*'msk-ray[ppo]'",
        ),
        "logger": (
            {"overrides": {"execution.loggers": ["mlflow"]}},
            "execution.loggers: mlflow needs .*'msk-ray[mlflow]'",
        ),
        "model": ({"overrides": {"env": {"name": "myoleg"}}}, "env.model: none of myosuite 2, .*pip install myo-sim"),
    }[setting]
    space = tmp_path / "small.yaml"
    space.write_text(dump_yaml(space_data | changes))
    arguments = ["--space", str(space), "--storage", str(tmp_path / "runs"), "--cpu"]
    with monkeypatch.context() as patch:
        for place in (packages, importlib.util):
            patch.setattr(place, "find_spec", lambda name: None)
        for how in (["--dry-run"], []):
            assert run(main, [*arguments, *how]) == 2
            error = capsys.readouterr().err
            assert re.search(message.replace("[", r"\["), error), error
            assert error.count("\n") == 1
    assert not plans
    assert not (tmp_path / "runs").exists()


def test_a_space_that_was_edited_is_not_told_to_run_the_command_that_was_refused(
    space_data: dict[str, Any], tmp_path: Path, plans: list[driver.Plan], capsys: pytest.CaptureFixture[str]
) -> None:
    space = tmp_path / "small.yaml"
    space.write_text(dump_yaml(space_data))
    arguments = ["--space", str(space), "--storage", str(tmp_path / "runs"), "--cpu"]
    assert run(main, arguments) == RESUMABLE
    command = Experiment(tmp_path / "runs" / "small").resume_command()
    capsys.readouterr()
    # Another command line: the one that started it still works, and is shown.
    assert run(main, [*arguments, "--resume", "--seeds", "0-1"]) == 2
    assert f"or continue it as it was started: {command}\n" in capsys.readouterr().err
    # Another file: no command line works.
    space.write_text(dump_yaml(space_data | {"parameters": {"shac.actor_lr": {"grid": [0.01, 0.002]}}}))
    for more in ([], ["--seeds", "0-1"]):
        assert run(main, [*arguments, "--resume", *more]) == 2
        error = capsys.readouterr().err
        assert "trial 1 changed: shac.actor_lr 0.001 → 0.002; undo that in the space or its base, or pass" in error
        assert "--resume" not in error.partition("--resume")[2]
    space.write_text(dump_yaml(space_data))
    assert run(main, [*arguments, "--resume"]) == RESUMABLE


@pytest.mark.parametrize("storage", ["plain", "a b", "it's\x1b[31m\n\u202e\\x"])
def test_the_command_to_continue_is_that_of_a_copy_under_another_name(
    storage: str, space_file: Path, tmp_path: Path, plans: list[driver.Plan], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / storage
    arguments = ["--space", str(space_file), "--cpu", f"--storage={folder}", "--na", "first"]
    monkeypatch.setattr(sys, "argv", ["msk-ray", *arguments])
    assert run(main, arguments) == RESUMABLE
    shutil.copytree(folder / "first", folder / "second")
    shutil.copytree(folder / "first", tmp_path / "elsewhere" / "first")
    for copy in (folder / "first", folder / "second", tmp_path / "elsewhere" / "first"):
        command = Experiment(copy).resume_command()
        assert command.isprintable()
        # As a shell would read it.
        words = subprocess.run(
            ["bash", "-c", f"printf '%s\\0' {command}"], capture_output=True, text=True, check=True
        ).stdout.split("\0")
        assert words[0] == "msk-ray"
        assert read_options(words[1:-1]).path == copy
        assert words.count("--name") + words.count("--na") == 1


def test_a_storage_that_is_not_utf_8_is_refused_before_anything_is_written(
    space_file: Path, tmp_path: Path, plans: list[driver.Plan], capsys: pytest.CaptureFixture[str]
) -> None:
    storage = tmp_path / os.fsdecode(b"runs\xff")
    assert run(main, ["--space", str(space_file), "--cpu", "--storage", str(storage)]) == 2
    assert "its path is not UTF-8; rename it, or choose another folder\n" in capsys.readouterr().err
    assert not plans
    assert not storage.exists()


def test_who_leaves_the_debugger_of_a_trial_sees_one_line(
    space_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def make_trainer(*_: object) -> None:
        raise bdb.BdbQuit

    monkeypatch.setattr("msk_ray.tune.trial_run.make_trainer", make_trainer)
    command = ["--space", str(space_file), "--storage", str(tmp_path / "runs"), "--cpu", "--debug-trial", "0"]
    assert run(main, command) == 130
    assert capsys.readouterr().err == "quit at a breakpoint\n"
    (folder,) = (tmp_path / "runs" / "debug").iterdir()
    assert not (folder / "error.txt").exists()
    assert not (folder / "outcome.json").exists(), "it has not ended"
