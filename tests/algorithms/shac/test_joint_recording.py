"""Processes of a trial record and replay the same: a collective operation is recorded everywhere or nowhere.

Without a GPU: only what they decide.
"""

import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from msk_ray.algorithms.shac.recorded_runner import RecordedRunner, _Recordings
from msk_ray.group import Group
from msk_ray.step.forward.solver_limits import SolverLimits


class Two(Group):
    """Two processes, of which the other always says the same."""

    size = 2

    def __init__(self, other: Any) -> None:
        self._other = other

    def collect(self, value: Any) -> list[Any]:
        return [value, self._other]


def runner_of(
    other: Any, engine: str = "engine", unrolled: tuple[int, ...] | None = (8, 5), counts: Any = None
) -> RecordedRunner:
    """A runner that has recorded an epoch of horizon 2, as far as decisions need it; `counts` are its solver's."""
    runner = object.__new__(RecordedRunner)
    runner._group = Two(other)
    counts = np.zeros((2, 128), int) if counts is None else counts
    batch = SimpleNamespace(
        ordered=False,
        stages=SimpleNamespace(unrolls=True),
        unrolled_iterations=unrolled,
        substeps=2,
        iterations=SimpleNamespace(read=lambda: counts),
        limits=SolverLimits(100, 50),
    )
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


def worlds(*by_substep: dict[int, int]) -> Any:
    """World counts by substep and iterations, from those that are not 0."""
    counts = np.zeros((len(by_substep), 128), int)
    for row, found in zip(counts, by_substep, strict=True):
        for iterations, number in found.items():
            row[iterations] = number
    return counts


@pytest.mark.parametrize(
    ("unrolled", "second", "other", "after", "kept"),
    [
        ((8, 5), {3: 995, 5: 5}, False, (8, 7), False),
        ((8, 5), {3: 998, 5: 2}, False, (8, 5), True),
        ((8, 5), {3: 998, 5: 2}, True, (8, 5), False),
        ((8, 100), {100: 1000}, False, (8, 100), True),
        (None, {}, True, (6, 6), False),
    ],
    ids=["0.5 %", "0.2 %", "another process has more", "the model's limit", "larger buffers"],
)
def test_where_too_many_worlds_reach_the_unrolled_iterations_all_processes_record_once_more(
    unrolled: tuple[int, ...] | None, second: dict[int, int], other: bool, after: tuple[int, ...], kept: bool
) -> None:
    """Each substep has a number of its own, which nothing else changes."""
    runner = runner_of(other, unrolled=unrolled, counts=worlds({7: 1000} if second else {}, second))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # more than 48 are too many
        runner.adapt()
    assert runner._env.sim.batch.unrolled_iterations == after
    if max(after) <= 48:
        assert bool(runner._kept.epochs) is kept


def test_an_epoch_operation_by_operation_says_how_many_iterations_to_unroll() -> None:
    """In the first substep 1 of 1000 worlds takes 9 or more, which is rare, and 12 take 8 or more."""
    counts = worlds({0: 500, 7: 488, 8: 11, 11: 1}, {2: 1000})
    runner = runner_of(False, unrolled=None, counts=counts)
    runner.recorded = False
    runner.adapt()
    assert runner._env.sim.batch.unrolled_iterations == (9, 6)


def test_a_solver_that_takes_very_many_iterations_is_not_unrolled() -> None:
    runner = runner_of(False, unrolled=None, counts=worlds({60: 1000}, {2: 1000}))
    runner.recorded = False
    with pytest.warns(UserWarning, match="more than 48 iterations"):
        runner.adapt()
    assert runner._epoch(INPUTS) is None
