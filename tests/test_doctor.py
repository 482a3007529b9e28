"""`doctor`: every line says ok or what to fix, and what is broken is found."""

import signal
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from processes import members_of, wait_until

from msk_ray import doctor, repeat
from msk_ray.cli import run
from msk_ray.config import dump_yaml
from msk_ray.doctor import GpuFacts, check_ray, check_storage, gpu_findings, main, package_findings
from msk_ray.progress import COMPILING

NO_GPU = GpuFacts(None, 0, None, "12.8", 0, (12, 9), 0, None)
TWO = GpuFacts("570.1", 2, (12, 8), "12.8", 2, (12, 9), 2, None)


def test_a_machine_without_gpu_is_fine_for_cpu_work() -> None:
    (finding,) = gpu_findings(NO_GPU, None)
    assert not finding.broken
    assert "trials run on CPU cores" in finding.text
    (finding,) = gpu_findings(NO_GPU, "cuda:0")
    assert finding.broken
    assert "--device cpu" in finding.text


def test_gpus_that_fit() -> None:
    (finding,) = gpu_findings(TWO, "cuda:1")
    assert not finding.broken
    assert finding.text == "2 GPU(s); driver 570.1 supports CUDA up to 12.8, torch built for 12.8, Warp for 12.9"


@pytest.mark.parametrize(
    ("facts", "device", "to_do"),
    [
        (replace(TWO, torch_cuda=None, torch_gpus=0), None, "torch is a CPU-only build"),
        (replace(TWO, torch_cuda="13.0", torch_gpus=0), None, "torch is built for CUDA 13.0 and cannot use the GPU"),
        (replace(TWO, warp_cuda=None, warp_gpus=0), None, "Warp is a build without CUDA"),
        (replace(TWO, warp_cuda=(13, 4), warp_gpus=0), None, "update the driver, or install a Warp build"),
        (replace(TWO, warp_cuda=(13, 4)), None, "driver 570.1, which supports CUDA up to 12.8"),
        (replace(TWO, visible="", torch_gpus=0, warp_gpus=0), None, "hides all GPUs: unset it"),
        (TWO, "cuda:2", "cuda:0 to cuda:1: name one of them"),
    ],
)
def test_gpus_that_do_not_fit(facts: GpuFacts, device: str | None, to_do: str) -> None:
    (finding,) = gpu_findings(facts, device)
    assert finding.broken
    assert to_do in finding.text
    if device is None:
        (left_alone,) = gpu_findings(facts, "cpu")
        assert not left_alone.broken


def test_packages() -> None:
    fine, old, missing = package_findings(
        {"a": ">=1.0", "B": ">=2,<3", "c": ">=1"},
        {"a": "1.5+cpu", "b": "3.0"},
    )
    assert (fine.broken, old.broken, missing.broken) == (False, True, True)
    assert "pip install 'B>=2,<3'" in old.text
    assert "c is missing" in missing.text


def test_storage_is_left_as_it_was(tmp_path: Path) -> None:
    finding = check_storage(tmp_path / "a" / "b")
    assert not finding.broken, finding
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    assert "choose another folder" in check_storage(tmp_path / "file" / "runs").text


def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "MIN_FREE_GB", 1e9)
    finding = check_storage(tmp_path)
    assert finding.broken
    assert "free some space" in finding.text


@pytest.fixture
def fake_ping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A script that runs in the place of the one that starts Ray."""
    path = tmp_path / "ping"
    monkeypatch.setattr(doctor, "RAY_PROBE", [str(path)])
    return path


def write_script(path: Path, body: str) -> None:
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)


def test_ray_that_works_fails_or_hangs(fake_ping: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_script(fake_ping, """echo noise; echo '{"worker": {}, "cpus": 4.0, "gpus": 1.0}'""")
    finding = check_ray()
    assert not finding.broken
    assert finding.text.endswith("4 CPUs, 1 GPUs")
    write_script(fake_ping, "echo 'ConnectionError: nobody there' >&2; exit 3")
    finding = check_ray()
    assert (finding.broken, finding.text) == (True, "does not start: ConnectionError: nobody there")
    write_script(fake_ping, "sleep 1000")
    started = []
    start = subprocess.Popen

    def noted(*command: Any, **options: Any) -> "subprocess.Popen[str]":
        started.append(start(*command, **options))
        return started[-1]

    monkeypatch.setattr(doctor.subprocess, "Popen", noted)
    finding = check_ray(limit_s=0.1)
    assert finding.broken
    assert "did not start within" in finding.text
    (process,) = started
    assert process.returncode == -signal.SIGKILL
    wait_until(lambda: not members_of(process.pid))


def test_the_whole_on_cpu(
    tmp_path: Path, fake_ping: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_script(fake_ping, """echo '{"worker": {}, "cpus": 4.0, "gpus": 0.0}'""")
    monkeypatch.setattr(doctor, "_gpu_facts", lambda: NO_GPU)
    assert run(main, ["--device", "cpu", "--storage", str(tmp_path / "runs")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines[:-1] if not line.endswith(" ...")] == [
        ["ok", name] for name in ("python", "packages", "gpu", "gradient", "ray", "storage")
    ]
    slow = {lines[at + 1].split()[1]: line for at, line in enumerate(lines) if line.endswith(" ...")}
    assert list(slow) == ["gpu", "gradient", "ray"], "what takes seconds says so first"
    assert COMPILING in slow["gradient"]
    assert lines[-1] == "all checks passed"


def test_something_broken_gives_exit_1(
    tmp_path: Path, fake_ping: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_script(fake_ping, "exit 9")
    monkeypatch.setattr(doctor, "_gpu_facts", lambda: NO_GPU)
    assert run(main, ["--device", "cuda:0", "--storage", "/proc/x"]) == 1
    text = capsys.readouterr().out
    for line in ("FIX   gpu", "FIX   gradient", "FIX   ray       does not start: exit code 9", "FIX   storage"):
        assert line in text
    assert "4 problem(s) to fix" in text


def test_without_its_packages_it_says_so_and_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "_NEEDED", ("json", "no_such_module_here"))
    assert run(main, ["--storage", str(tmp_path / "runs")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2:] == [
        "FIX   packages  no_such_module_here cannot be imported: nothing else was checked",
        "1 problem(s) to fix",
    ]


@pytest.fixture
def small_trial(tmp_path: Path, tiny_settings: dict[str, Any]) -> str:
    path = tmp_path / "small.yaml"
    path.write_text(dump_yaml(tiny_settings))
    return str(path)


@pytest.mark.long
def test_a_trial_repeats_in_another_process_with_more_threads(
    small_trial: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--repeat", small_trial, "--device", "cpu", "--epochs", "1", "--set", "execution.deterministic=true"]
    assert main(words) == 0
    assert "1 epoch(s) on cpu twice: " in capsys.readouterr().out


def test_a_trial_that_does_not_repeat(
    small_trial: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = iter(
        [
            [(0, "worlds", "qpos", "a"), (1, "rollout", "rewards", "b"), (1, "rollout", "qpos", "c")],
            [(0, "worlds", "qpos", "a"), (1, "rollout", "rewards", "x"), (1, "rollout", "qpos", "y")],
        ]
    )
    monkeypatch.setattr(repeat, "run_once", lambda *_: next(runs))
    assert main(["--repeat", small_trial, "--device", "cuda:0"]) == 1
    line = capsys.readouterr().out.splitlines()[0]
    assert line.startswith("FIX")
    assert "differ first in epoch 1, stage rollout: rewards, qpos; write execution.deterministic: true" in line


def test_where_two_runs_begin_to_differ() -> None:
    one: list[repeat.StageDigest] = [
        (0, "worlds", "qpos", "a"),
        (1, "draws", "noise", "b"),
        (1, "rollout", "rewards", "c"),
    ]
    assert repeat.first_difference(one, list(one)) is None
    other = [*one[:2], (1, "rollout", "rewards", "d")]
    assert repeat.first_difference(one, other) == repeat.Difference(1, "rollout", ("rewards",))
    assert str(repeat.first_difference(one, one[:2])) == "in epoch 1, stage rollout: rewards"
    assert str(repeat.first_difference([], one)) == "before the first epoch, stage worlds: qpos"


def test_options_of_repeat_are_not_ignored(small_trial: str, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--epochs", "3"], ["--set", "trial.seed=1"]):
        assert run(main, words) != 0
        assert "go with --repeat" in capsys.readouterr().err
    assert run(main, ["--repeat", small_trial, "--epochs", "0"]) != 0
    assert run(main, ["--repeat", small_trial, "--set", "execution.gpus=2"]) != 0
