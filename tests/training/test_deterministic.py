"""`execution.deterministic`: the same bits after any death; `tests/test_doctor.py` compares processes."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from processes import Launcher, wait_until

from msk_ray.config import Config, parse_config
from msk_ray.errors import ConfigError
from msk_ray.training import Trainer, read_metrics
from msk_ray.training.determinism import use_determinism

ANT = {
    "env": {"name": "ant", "nworld": 6},
    "physics": {"variant": "matched"},
    "shac": {"horizon": 4, "critic_iterations": 2, "critic_batches": 2},
    "actor": {"hidden": [16, 16]},
    "critic": {"hidden": [16, 16]},
    "evaluation": {"interval": 1, "nworld": 2, "steps": 5},
    "trial": {"epochs": 3},
    "execution": {"checkpoint_interval": 1, "deterministic": True},
}


@pytest.fixture(autouse=True)
def torch_as_before() -> Iterator[None]:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)
    use_determinism(parse_config({"env": {"name": "cartpole"}}), "cpu")


def hashes(folder: Path) -> list[float]:
    return [row["hash/parameters"] for row in read_metrics(folder / "metrics.jsonl") if "hash/parameters" in row]


def rows_of(folder: Path) -> int:
    path = folder / "metrics.jsonl"
    return path.read_text().count("\n") if path.exists() else 0


def train(config: Config, folder: Path, epochs: int) -> Trainer:
    trainer = Trainer(config, folder, "cpu")
    trainer.restore_latest()
    for _ in range(epochs):
        trainer.run_epoch()
    trainer.close()
    return trainer


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[float]:
    """Hashes of a trial that is trained in one go, in this process."""
    folder = tmp_path_factory.mktemp("whole")
    trainer = train(parse_config(ANT), folder, 3)
    assert trainer.env.sim.batch.ordered
    assert trainer.evaluator.env.sim.batch.ordered
    assert torch.are_deterministic_algorithms_enabled()
    assert json.loads((folder / "env.json").read_text())["deterministic"] is True
    found = hashes(folder)
    assert len(set(found)) == 4
    return found


def test_a_resumed_trial_learns_the_same_bits(whole: list[float], tmp_path: Path) -> None:
    train(parse_config(ANT), tmp_path, 1)
    train(parse_config(ANT), tmp_path, 2)
    assert hashes(tmp_path) == whole


@pytest.mark.parametrize(
    "config",
    [
        *(pytest.param(name, marks=pytest.mark.gpu) for name in ("ant", "myoleg26")),
        *(
            pytest.param(name, marks=pytest.mark.gpu_slow)
            for name in ("cartpole", "ant_hard_friction", "ant_published")
        ),
    ],
)
def test_a_gpu_repeats_a_trial_that_is_killed_in_between(config: str, tmp_path: Path, launcher: Launcher) -> None:
    own = {"horizon": 8, "critic_iterations": 4}
    settings = [
        *("execution.deterministic=true", "trial.epochs=8", "execution.checkpoint_interval=1", "env.nworld=256"),
        *(f"shac.{key}={value}" for key, value in own.items()),
        *("evaluation.interval=2", "evaluation.nworld=16", "evaluation.steps=20"),
    ]

    def command(folder: Path, *more: str) -> list[str]:
        sets = [word for setting in settings for word in ("--set", setting)]
        start = [sys.executable, "-m", "msk_ray.train", "--config", config, "--score-at-once"]
        return [*start, "--device", "cuda:0", "--logdir", str(folder), *sets, *more]

    # Beside each other: most of their time passes while each loads libraries and compiles.
    names = ("first", "second", "killed")
    first, second, killed = (launcher.start(command(tmp_path / n), stdout=subprocess.DEVNULL) for n in names)
    wait_until(lambda: rows_of(tmp_path / "killed") > 3, killed)
    killed.kill()
    killed.wait()
    resumed = launcher.start(command(tmp_path / "killed", "--resume"), stdout=subprocess.DEVNULL)
    assert [process.wait() for process in (first, second, resumed)] == [0, 0, 0]
    assert hashes(tmp_path / "first") == hashes(tmp_path / "second")
    assert hashes(tmp_path / "killed") == hashes(tmp_path / "first")


def test_torch_is_as_before_in_the_next_trial(tiny_settings: dict[str, Any]) -> None:
    use_determinism(parse_config(ANT), "cpu")
    assert torch.are_deterministic_algorithms_enabled()
    use_determinism(parse_config(tiny_settings), "cpu")
    assert not torch.are_deterministic_algorithms_enabled()


@pytest.mark.parametrize(
    ("change", "write"),
    [
        ({"execution": {"jacobian": "sparse", "deterministic": True}}, "execution.jacobian: dense"),
        ({"physics": {"integrator": "RK4"}}, "physics.integrator: Euler or implicitfast"),
        ({"execution": {"gpus": 2, "deterministic": True}}, "execution.gpus: 1"),
    ],
)
def test_what_has_no_fixed_order_is_refused_with_what_to_write(change: dict[str, Any], write: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"write {write}")):
        parse_config(ANT | change)
