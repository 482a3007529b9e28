"""Sweeps with the stub trainer in a Ray of the tests' own."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import stub_trainer
from lean_ray import lean_ray
from ray import cloudpickle
from stub_trainer import StubTrainer

from msk_ray.experiment.records import TrialRecord, read_records
from msk_ray.sweep import opening
from msk_ray.sweep.space import Space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune import driver
from msk_ray.tune.devices import Placement
from msk_ray.tune.finish import finish
from msk_ray.tune.session import ray_session


@pytest.fixture(scope="module")
def stub_session() -> Iterator[None]:
    """One Ray for all tests of a file."""
    cloudpickle.register_pickle_by_value(stub_trainer)
    handlers = {
        number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
    }
    with lean_ray(), ray_session(None, dashboard=False, trials=False):  # stubs need none of what trials import
        yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


def go(space: Space, path: Path, resume: bool = False) -> tuple[bool, list[TrialRecord]]:
    searching = space.file.search == "optuna"
    trials = [] if searching else resolve_trials(space)
    experiment = (
        opening.reopen(path, None if searching else trials) if resume else opening.create(path, space, trials, {})
    )
    plan = driver.Plan(experiment, space, trials, Placement(0.0, 1), None, StubTrainer, precompile=None, prestart=False)
    completed = driver.run_trials(plan)
    finish(experiment)
    return completed, read_records(experiment)


def interrupted(space: Space, path: Path) -> list[TrialRecord]:
    """A sweep that is asked to stop, by a signal, once a trial has begun to train."""
    timer = threading.Thread(target=_terminate_when, args=(path,))
    timer.start()
    completed, records = go(space, path)
    timer.join()
    assert not completed
    return records


def outcomes(records: list[TrialRecord]) -> list[str | None]:
    return [record.ending and str(record.ending.outcome) for record in records]


def _terminate_when(path: Path) -> None:
    """SIGTERM to this process once a trial has begun to train."""
    while not list(path.glob("trials/*/checkpoints/epoch_000004.pt")):
        if (path / "summary.json").exists():
            return  # the sweep has ended without it
        time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGTERM)
