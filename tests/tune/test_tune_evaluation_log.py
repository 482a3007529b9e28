"""Early stopping continues after a driver's death as if nothing had happened: killed after every single report."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from msk_ray.experiment.evaluation_log import EvaluationLog, LogEntry
from msk_ray.experiment.outcomes import Ending
from msk_ray.sweep import opening
from msk_ray.sweep.rules.asha import Asha
from msk_ray.sweep.rules.median import Median
from msk_ray.sweep.rules.scheduler import SchedulerSpec, replay
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune import driver
from msk_ray.tune.devices import Placement
from msk_ray.tune.schedulers import METRIC, PruningScheduler

EPOCHS = 24
CHECKPOINT_INTERVAL = 4
# Crossing curves: the late risers would be stopped or not depending on who is compared with whom, and when.
CURVES = {"a": (5.0, 0.1), "b": (4.0, 0.3), "c": (0.0, 0.6), "d": (3.0, 0.0), "e": (6.0, -0.2), "f": (1.0, 0.55)}


class Driver:
    """The scheduler of one driver's life over stub trials that report in turn."""

    def __init__(self, spec: SchedulerSpec, path: Path) -> None:
        journal = EvaluationLog(path)
        pruner = spec.pruner(100 * EPOCHS)
        replay(pruner, spec.time_attr, journal.read()[0])
        self.stopped: dict[str, tuple[int, str]] = {}
        self._epoch = 0
        self._scheduler = PruningScheduler(pruner, spec.time_attr, journal, lambda trial: trial.id, self._stop)

    def _stop(self, trial: str, ending: Ending) -> None:
        self.stopped[trial] = self._epoch, ending.why

    def report(self, trial: str, epoch: int) -> None:
        self._epoch = epoch
        start, slope = CURVES[trial]
        result = {METRIC: start + slope * epoch, "epoch": epoch, "env_steps": 100 * epoch, "seconds": 0.1 * epoch}
        result |= {"ended": epoch == EPOCHS, "attempt": 1}
        self._scheduler.on_trial_result(None, SimpleNamespace(id=trial), result)


def order() -> list[tuple[str, int]]:
    """(trial, epoch) as reports arrive: two waves of three trials, not quite in lockstep."""
    waves = [[(t, e) for e in range(1, EPOCHS + 1) for t in wave] for wave in (("a", "d", "c"), ("e", "b", "f"))]
    return waves[0] + waves[1]


def life(driver: Driver, reports: list[tuple[str, int]], stopped: dict[str, Any]) -> None:
    for trial, epoch in reports:
        if trial not in stopped:
            driver.report(trial, epoch)
            stopped |= driver.stopped


@pytest.mark.parametrize("kind", ["asha", "median"])
def test_a_driver_killed_after_any_report_stops_the_same_trials_at_the_same_epochs(kind: Any, tmp_path: Path) -> None:
    spec = (
        Asha(kind=kind, grace=0.15, reduction=2.0, min_trials=2)
        if kind == "asha"
        else Median(kind=kind, grace=0.15, min_trials=2)
    )
    whole: dict[str, Any] = {}
    life(Driver(spec, tmp_path / "whole"), order(), whole)
    assert 2 <= len(whole) < len(CURVES)
    reports = order()
    for killed_after in range(1, len(reports)):
        path = tmp_path / f"{killed_after}"
        stopped: dict[str, Any] = {}
        life(Driver(spec, path), reports[:killed_after], stopped)
        with path.open("a") as file:
            file.write('{"trial": "a", "epo')  # it died in the middle of a line
        # Trials continue from their checkpoints, and report again what came after those.
        again = [(t, e) for t, e in reports[:killed_after] if e > _checkpoint(t, reports[:killed_after])]
        life(Driver(spec, path), again + reports[killed_after:], stopped)
        assert stopped == whole


def _checkpoint(trial: str, reports: list[tuple[str, int]]) -> int:
    newest = max(epoch for name, epoch in reports if name == trial)
    return newest // CHECKPOINT_INTERVAL * CHECKPOINT_INTERVAL - 1  # the report at the checkpoint is repeated


def test_a_stop_that_was_decided_but_not_carried_out_is_found(tmp_path: Path) -> None:
    spec = Asha(kind="asha", grace=0.5, reduction=2.0, min_trials=2)
    reports = [LogEntry("good", 5, 500, 1.0, 2.0, False), LogEntry("bad", 5, 500, 1.0, 1.0, False)]
    ending = replay(spec.pruner(1000), "env_steps", reports)
    assert ending is not None
    assert "number 2 of 2" in ending.why
    assert replay(spec.pruner(1000), "env_steps", reports[:1]) is None


def test_a_torn_end_is_cut_off(tmp_path: Path) -> None:
    journal = EvaluationLog(tmp_path / "j")
    report = LogEntry("a", 1, 100, 0.5, 2.0, False)
    journal.append(report)
    with (tmp_path / "j").open("a") as file:
        file.write('{"trial"')
    assert journal.read() == ([report], ())
    journal.append(report)
    assert [json.loads(line)["trial"] for line in (tmp_path / "j").read_text().splitlines()] == ["a", "a"]


def test_each_environment_has_rungs_of_its_own(make_space: Any, tmp_path: Path) -> None:
    bodies = [{"label": name, "value": {"name": name, "nworld": n}} for name, n in (("cartpole", 8), ("hopper", 64))]
    parameters = {"env": {"grid": bodies}, "shac.actor_lr": {"grid": [0.01, 0.001]}}
    scheduler = {"kind": "asha", "grace": 0.25, "reduction": 2.0, "min_trials": 2}
    space = make_space(parameters=parameters, scheduler=scheduler)
    trials = resolve_trials(space)
    experiment = opening.create(tmp_path / "runs" / "two", space, trials, {})
    pruner = driver._pruner(driver.Plan(experiment, space, trials, Placement(0.0, 1), None))
    # Twenty epochs of 8 steps: 1280 env steps of cartpole, whose first rung is at 320, and 10240 of hopper.
    good, bad = (trial.id for trial in trials if trial.environment == "cartpole")
    assert pruner.report(good, 320, 2.0) is None
    assert "rung 320" in getattr(pruner.report(bad, 320, 1.0), "why", "")
    good, bad = (trial.id for trial in trials if trial.environment == "hopper")
    assert (pruner.report(good, 2559, -5.0), pruner.report(bad, 2559, -9.0)) == (None, None)
    assert pruner.report(good, 2560, -5.0) is None, "below every cartpole"
    assert "rung 2560" in getattr(pruner.report(bad, 2560, -9.0), "why", "")
