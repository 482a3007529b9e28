"""A trial on two GPUs: recorded epochs that hold NCCL's operations, and a death that leaves the others inside one."""

import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from fault_campaign.processes import stat_of

from msk_ray.config import parse_config
from msk_ray.errors import RankLost
from msk_ray.training import ParallelTrainer, make_trainer

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs"),
]

SETTINGS: dict[str, Any] = {
    "env": {"name": "ant", "nworld": 128},
    "physics": {"variant": "matched"},
    "shac": {"horizon": 4, "critic_iterations": 4, "state_grad_clip": 100.0, "normalize_return": True},
    "evaluation": {"interval": 1000, "nworld": 2, "steps": 2},
}
FIGURES = ("train/reward", "train/actor_loss", "train/value", "grad/actor_norm", "grad/state_median")


def make(folder: Path, gpus: int) -> Any:
    execution = {"checkpoint_interval": 1000, "loggers": [], "gpus": gpus}
    config = {**SETTINGS, "trial": {"epochs": 1000}, "execution": execution}
    return make_trainer(parse_config(config), folder, "cuda:0")


def figures(row: dict[str, float]) -> dict[str, float]:
    return {name: row[name] for name in FIGURES}


def test_recorded_epochs_on_two_gpus_are_those_of_one_and_are_resumed(tmp_path: Path) -> None:
    one, two = make(tmp_path / "one", 1), make(tmp_path / "two", 2)
    assert isinstance(two, ParallelTrainer)
    rows = [(one.run_epoch(), two.run_epoch()) for _ in range(4)]
    assert [ours["train/recorded"] for _, ours in rows] == [0.0, 1.0, 1.0, 1.0]
    # Sums by atomics differ in their last bits, and contacts make more of that from epoch to epoch.
    for (theirs, ours), tolerance in zip(rows[:2], (1e-4, 1e-3), strict=True):
        assert figures(ours) == pytest.approx(figures(theirs), rel=tolerance)
    path = two.save()
    following = two.run_epoch()
    two.restore(path)
    assert figures(two.run_epoch()) == pytest.approx(figures(following), rel=1e-3)
    for trainer in (one, two):
        trainer.close()


def test_a_killed_process_ends_those_that_wait_for_it_on_their_gpu(tmp_path: Path) -> None:
    trainer = make(tmp_path, 2)
    for _ in range(3):
        trainer.run_epoch()
    pids = [rank.process.pid for rank in trainer._ranks]
    os.kill(pids[1], signal.SIGKILL)
    with pytest.raises(RankLost, match=r"process 1 of the trial \(pid \d+\) was ended by SIGKILL"):
        trainer.run_epoch()
    assert not any(map(stat_of, pids))
