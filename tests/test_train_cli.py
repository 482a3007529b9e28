"""`python -m msk_ray.train` with inputs a user may get wrong: one line, a non-zero exit, nothing written."""

from pathlib import Path
from typing import Any

import pytest

from msk_ray.algorithms.shac.runner import EagerRunner
from msk_ray.cli import run
from msk_ray.config import dump_yaml
from msk_ray.errors import DeviceError
from msk_ray.experiment.metrics import read_metrics
from msk_ray.train import main
from msk_ray.training import Evaluator

pytestmark = pytest.mark.long


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "shac.horizn=3"], "did you mean 'horizon'?"),
        (["--set", "shac.horizon=0"], "shac.horizon"),
        (["--set", "shac.horizon"], "write key=value"),
        (["--set", "physics.timestep=0.003"], "does not divide"),
        (["--config", "configs/nope.yaml"], "no such file"),
        (["--device", "cuda:7"], "cuda:7"),
        (["--device", "tpu"], "write cpu, cuda or cuda:0"),
        (["--resume", "--logdir", "nowhere"], "no trial in nowhere"),
        (["--logdir", "/proc/nowhere"], "cannot write to /proc/nowhere"),
    ],
)
def test_bad_input_is_one_line(
    root: Path,
    tmp_path: Path,
    arguments: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "configs").mkdir()
    monkeypatch.chdir(tmp_path)
    base = [] if "--config" in arguments else ["--config", str(root / "configs" / "cartpole.yaml")]
    assert run(main, [*base, *arguments]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith("error: ")
    assert message in error
    assert not list(tmp_path.rglob("metrics.jsonl"))


def test_what_made_it_slow_is_said_to_the_end(
    tiny_settings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As on a GPU where something cannot be recorded."""
    monkeypatch.setattr(EagerRunner, "refusal", "walker.py:3 cannot be recorded (it waits)")
    tiny_settings["trial"] |= {"epochs": 2, "loggers": []}
    (tmp_path / "tiny.yaml").write_text(dump_yaml(tiny_settings))
    words = ["--config", str(tmp_path / "tiny.yaml"), "--logdir", str(tmp_path / "out"), "--device", "cpu"]
    assert run(main, words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "epoch 2/2" in lines[-4]
    assert "not recorded: two to three times as slow" in lines[-4]
    assert lines[-3] == (
        "epochs run operation by operation, not as recorded graphs, and take two to three times as long: walker.py:3 "
        "cannot be recorded (it waits)"
    )
    assert read_metrics(tmp_path / "out" / "metrics.jsonl")[-1]["train/unrecordable"] == 1.0


def test_what_is_waited_for_and_what_was_not_learned_is_said(
    tiny_settings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Here training makes it worse: 10 untrained, then 9."""
    scores = iter((10.0, 9.0))
    monkeypatch.setattr(Evaluator, "run", lambda self, policies: [{"score": next(scores)}])
    tiny_settings["trial"] |= {"epochs": 2}
    tiny_settings["execution"] |= {"loggers": []}
    tiny_settings["shac"]["horizon"] = {"kind": "schedule", "start": 8, "end": 16, "epochs": 20}
    (tmp_path / "tiny.yaml").write_text(dump_yaml(tiny_settings))
    words = ["--config", str(tmp_path / "tiny.yaml"), "--logdir", str(tmp_path / "out"), "--device", "cpu"]
    assert run(main, words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == (
        "shac.horizon.epochs is epoch 20, but training ends at trial.epochs, 2: the schedule stays unfinished"
    )
    assert "scoring the first policy in 4 worlds, then training ..." in lines
    assert lines[-3].startswith("best score of a trained policy 9.0 (untrained 10.0): ")
    assert lines[-2].startswith("no trained policy scored higher than the first one")


def test_a_folder_that_holds_a_trial_is_left_alone(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"epoch": 0}\n')
    assert run(main, ["--config", str(root / "configs" / "cartpole.yaml"), "--logdir", str(tmp_path)]) == 2
    assert "add --resume" in capsys.readouterr().err
    assert (tmp_path / "metrics.jsonl").read_text() == '{"epoch": 0}\n'


def test_a_trial_without_a_complete_checkpoint_is_not_restarted(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "epoch_000004.pt").write_bytes(b"torn")
    (tmp_path / "metrics.jsonl").write_text('{"epoch": 0}\n{"epoch": 1}\n')
    config = str(root / "configs" / "cartpole.yaml")
    assert run(main, ["--config", config, "--logdir", str(tmp_path), "--device", "cpu", "--resume"]) == 2
    error = capsys.readouterr().err
    assert "is complete" in error
    assert "choose another --logdir to start again" in error
    assert (tmp_path / "metrics.jsonl").read_text() == '{"epoch": 0}\n{"epoch": 1}\n'
    assert not (tmp_path / "config.yaml").exists()


def test_help_teaches_by_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    assert "--config configs/cartpole.yaml" in capsys.readouterr().out


def test_it_speaks_before_torch_is_loaded(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Which takes seconds."""

    def load(asked: str | None) -> str:
        raise DeviceError("loading")

    monkeypatch.setattr("msk_ray.train._choose_device", load)
    assert run(main, ["--config", str(root / "configs" / "cartpole.yaml"), "--logdir", str(tmp_path)]) == 2
    assert capsys.readouterr().out == f"cartpole: 300 epochs, 64 worlds; log folder {tmp_path}\n"
