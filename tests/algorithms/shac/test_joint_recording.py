"""Processes of a trial record and replay the same: a collective operation is recorded everywhere or nowhere.

Without a GPU: only what they decide.
"""

import warnings
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from msk_ray.algorithms.shac.runner import RecordedRunner, _Recordings
from msk_ray.group import Group


class Two(Group):
    """Two processes, of which the other always says the same."""

    size = 2

    def __init__(self, other: Any) -> None:
        self._other = other

    def collect(self, value: Any) -> list[Any]:
        return [value, self._other]


def runner_of(other: Any, engine: str = "engine", unrolled: int | None = 8) -> RecordedRunner:
    """A runner that has recorded an epoch of horizon 2, as far as decisions need it."""
    runner = object.__new__(RecordedRunner)
    runner._group = Two(other)
    batch = SimpleNamespace(unrolled_iterations=unrolled, mjm=SimpleNamespace(opt=SimpleNamespace(iterations=100)))
    runner._env = SimpleNamespace(sim=SimpleNamespace(engine=engine, batch=batch))  # type: ignore[assignment]
    runner._kept = _Recordings("engine", warm={2})  # type: ignore[arg-type]
    runner._kept.epochs[2] = "recorded"  # type: ignore[assignment]
    runner._refused = False
    runner.recorded = True
    return runner


INPUTS: Any = SimpleNamespace(noise=torch.zeros(2, 1, 1))


def test_what_another_process_cannot_record_is_not_recorded_here() -> None:
    runner = runner_of("own_robot.py:7 cannot be recorded (it waits)")
    with pytest.warns(UserWarning, match=r"operation by operation, .*own_robot\.py:7 cannot be recorded \(it waits\)"):
        assert runner._attempt(lambda: "recorded") is None  # type: ignore[arg-type, return-value]
    assert not runner._kept.epochs
    assert runner._epoch(INPUTS) is None


def test_nor_in_another_what_cannot_be_recorded_here() -> None:
    def fail() -> Any:
        raise RuntimeError("waits")

    with pytest.warns(UserWarning, match=r"test_joint_recording\.py:\d+ cannot be recorded \(waits\)"):
        assert runner_of("")._attempt(fail) is None


def test_a_recording_that_all_made_is_used() -> None:
    runner = runner_of("")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert runner._attempt(lambda: "recorded") == "recorded"  # type: ignore[arg-type, comparison-overlap, return-value]


@pytest.mark.parametrize(
    ("engine", "other", "kept"), [("engine", False, True), ("larger", False, False), ("engine", True, False)]
)
def test_recordings_end_everywhere_when_buffers_have_grown_anywhere(engine: str, other: bool, kept: bool) -> None:
    """And the next epoch runs operation by operation in all, to be recorded after it."""
    runner = runner_of(other, engine)
    assert (runner._epoch(INPUTS) == "recorded") is kept
    assert runner._kept.engine == engine
    assert runner._kept.warm == {2}


@pytest.mark.parametrize(
    ("unrolled", "other", "after", "kept"),
    [(8, True, 12, False), (None, True, None, False), (100, True, 100, False), (100, False, 100, True)],
)
def test_recordings_end_everywhere_when_one_process_unrolls_more_iterations(
    unrolled: int | None, other: bool, after: int | None, kept: bool
) -> None:
    """A process whose batch has just grown has none yet, and one at the model's limit needs no more."""
    runner = runner_of(other, unrolled=unrolled)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the other also says that it has too many
        runner.adapt(0.5)
    assert runner._env.sim.batch.unrolled_iterations == after
    assert bool(runner._kept.epochs) is kept


def test_few_worlds_at_the_limit_change_nothing() -> None:
    runner = runner_of(True)
    runner.adapt(0.005)
    assert runner._kept.epochs
