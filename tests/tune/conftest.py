"""What a driver would run."""

import contextlib

import pytest
from stub_runs import stub_session

from msk_ray.tune import driver, session


@pytest.fixture
def plans(monkeypatch: pytest.MonkeyPatch) -> list[driver.Plan]:
    """What a driver would run: it gets as far as its plan, and ends as if it had been stopped there."""
    made: list[driver.Plan] = []
    monkeypatch.setattr(session, "ray_session", lambda *args: contextlib.nullcontext())
    monkeypatch.setattr(driver, "run_trials", lambda plan: bool(made.append(plan)))
    return made


__all__ = ["plans", "stub_session"]
