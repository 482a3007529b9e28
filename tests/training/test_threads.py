"""Torch's threads are a trial's setting: the same wherever it runs, and known to earlier records as one."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from msk_ray.config import Config
from msk_ray.errors import ConfigError
from msk_ray.evaluate.measure import Bench, Request
from msk_ray.sweep.space import ResourcesSpec
from msk_ray.training import Trainer, load_policy
from msk_ray.tune.devices import check_threads


@pytest.fixture(autouse=True)
def machine() -> Iterator[None]:
    """A machine on which torch would take three threads by itself."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def with_threads(config: Config, threads: int) -> Config:
    return config.model_copy(update={"execution": config.execution.model_copy(update={"threads": threads})})


def test_a_trial_computes_with_one_thread_or_as_many_as_it_says(tiny_cartpole: Config, tmp_path: Path) -> None:
    Trainer(tiny_cartpole, tmp_path / "one", "cpu").close()
    assert torch.get_num_threads() == 1
    assert "threads: 1\n" in (tmp_path / "one" / "config.yaml").read_text()
    Trainer(with_threads(tiny_cartpole, 2), tmp_path / "two", "cpu").close()
    assert torch.get_num_threads() == 2


def test_a_policy_is_evaluated_with_the_threads_it_was_trained_with(tiny_cartpole: Config, tmp_path: Path) -> None:
    trainer = Trainer(tiny_cartpole, tmp_path, "cpu")
    path = trainer.save()
    trainer.close()
    torch.set_num_threads(3)
    Bench("cpu").evaluate(load_policy(path), Request())
    assert torch.get_num_threads() == 1


def test_a_trial_may_go_on_with_other_threads(tiny_cartpole: Config, tmp_path: Path) -> None:
    first = Trainer(tiny_cartpole, tmp_path, "cpu")
    first.run_epoch()
    path = first.save()
    first.close()
    second = Trainer(with_threads(tiny_cartpole, 2), tmp_path, "cpu")
    with pytest.warns(UserWarning, match=r"execution\.threads 1, now 2: the same to rounding, not to the bit"):
        assert second.restore_latest() == (path, [])
    second.close()


def test_more_threads_than_cores_are_refused(tiny_cartpole: Config) -> None:
    check_threads([tiny_cartpole, with_threads(tiny_cartpole, 2)], ResourcesSpec(cpus_per_trial=2))
    with pytest.raises(ConfigError, match=r"threads 2, 1 cores per trial: write resources\.cpus_per_trial: 2"):
        check_threads([tiny_cartpole, with_threads(tiny_cartpole, 2)], ResourcesSpec())
