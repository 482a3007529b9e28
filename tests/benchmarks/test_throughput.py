"""The benchmark of trials beside each other: what it makes of trials' files. Its figures need GPUs."""

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from msk_ray.experiment.outcomes import Ending, Outcome, write_ending
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials


@pytest.fixture
def benchmark(root: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(root / "benchmarks"))
    yield importlib.import_module("throughput")
    for name in ("throughput", "record"):
        sys.modules.pop(name, None)


def write_trial(folder: Path, speeds: list[float], visible: str, count: int, outcome: Outcome) -> None:
    folder.mkdir(parents=True)
    rows = [{"epoch": i, "env_steps": i, "seconds": float(i), "env_steps_per_s": s} for i, s in enumerate(speeds)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "device.json").write_text(json.dumps({"visible": visible, "count": count}))
    write_ending(folder, Ending(outcome, "so"))


def test_speeds_and_what_they_say(benchmark: ModuleType, tmp_path: Path) -> None:
    # The first five epochs and the row before them are slow, and do not count.
    slow = [1.0] * 6
    write_trial(tmp_path / "alone" / "trials" / "a", [*slow, 90, 100, 110], "0", 1, Outcome.WALL_TIME)
    write_trial(tmp_path / "apart" / "trials" / "b", [*slow, 98, 98, 98], "0", 1, Outcome.WALL_TIME)
    write_trial(tmp_path / "apart" / "trials" / "c", [*slow, 96, 99, 100], "1", 2, Outcome.WALL_TIME)
    for name in "defg":
        write_trial(tmp_path / "sharing" / "trials" / name, [*slow, 40, 40, 40], "0", 1, Outcome.WALL_TIME)
    alone, apart, sharing = (benchmark.read_speeds(tmp_path / name) for name in ("alone", "apart", "sharing"))
    assert [speed.env_steps_per_s for speed in (*alone, *apart)] == [100, 98, 99]
    assert benchmark.summary(alone, apart, sharing) == [
        "2 trials, a device each: 0.980 to 0.990 of a lone trial, median 0.985",
        "4 trials on one GPU: 160 env steps/s together, 1.60 of a lone one",
        "trial c saw 2 GPUs instead of one",
    ]


def test_a_trial_that_did_not_train_to_its_end_is_no_figure(benchmark: ModuleType, tmp_path: Path) -> None:
    write_trial(tmp_path / "alone" / "trials" / "a", [1.0] * 9, "0", 1, Outcome.ERROR)
    with pytest.raises(SystemExit, match=r"output\.log"):
        benchmark.read_speeds(tmp_path / "alone")


def test_its_space_is_one(benchmark: ModuleType, root: Path) -> None:
    for name in ("ant", "cartpole"):
        data = benchmark.space(root / "configs" / f"{name}.yaml", 8, 15.0, {"env.nworld": 64})
        trials = resolve_trials(parse_space(data, root / "throughput.yaml"))
        assert [trial.seed for trial in trials] == list(range(8))
        assert {trial.config.env.nworld for trial in trials} == {64}


def test_without_a_gpu_it_says_what_to_pass(benchmark: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "local_gpus", lambda: 0)
    with pytest.raises(SystemExit, match="pass --cpu"):
        benchmark.main([])
