"""`python -m msk_ray.train` with inputs a user may get wrong: one line, a non-zero exit, nothing written."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from msk_ray.cli import run
from msk_ray.errors import DeviceError
from msk_ray.train import main

pytestmark = pytest.mark.long


def train(root: Path, cwd: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(root)}
    return subprocess.run(
        [sys.executable, "-m", "msk_ray.train", *arguments], cwd=cwd, env=environment, capture_output=True, text=True
    )


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


def test_a_folder_that_holds_a_trial_is_left_alone(root: Path, tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"epoch": 0}\n')
    result = train(root, tmp_path, "--config", str(root / "configs" / "cartpole.yaml"), "--logdir", str(tmp_path))
    assert result.returncode == 2
    assert "add --resume" in result.stderr
    assert (tmp_path / "metrics.jsonl").read_text() == '{"epoch": 0}\n'


def test_a_trial_without_a_complete_checkpoint_is_not_restarted(root: Path, tmp_path: Path) -> None:
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "epoch_000004.pt").write_bytes(b"torn")
    (tmp_path / "metrics.jsonl").write_text('{"epoch": 0}\n{"epoch": 1}\n')
    config = str(root / "configs" / "cartpole.yaml")
    result = train(root, tmp_path, "--config", config, "--logdir", str(tmp_path), "--resume")
    assert result.returncode == 2
    assert "is complete" in result.stderr
    assert "choose another --logdir to start again" in result.stderr
    assert (tmp_path / "metrics.jsonl").read_text() == '{"epoch": 0}\n{"epoch": 1}\n'
    assert not (tmp_path / "config.yaml").exists()


def test_help_teaches_by_example(root: Path, tmp_path: Path) -> None:
    result = train(root, tmp_path, "--help")
    assert result.returncode == 0
    assert "--config configs/cartpole.yaml" in result.stdout


def test_it_speaks_before_torch_is_loaded(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Which takes seconds."""

    def load(asked: str | None) -> str:
        raise DeviceError("loading")

    monkeypatch.setattr("msk_ray.train._choose_device", load)
    assert run(main, ["--config", str(root / "configs" / "cartpole.yaml"), "--logdir", str(tmp_path)]) == 2
    assert capsys.readouterr().out == f"cartpole: 300 epochs, 64 worlds; log folder {tmp_path}\n"
