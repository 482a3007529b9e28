"""What the driver decides while trials run, on a clock of its own."""

import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from msk_ray.experiment.attempts import FIRST
from msk_ray.experiment.trial import Trial
from msk_ray.signals import listening
from msk_ray.sweep import opening
from msk_ray.sweep.space import Space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune import supervisor
from msk_ray.tune.console import Console
from msk_ray.tune.supervisor import LONGEST_STEP_S, SHUTDOWN_GRACE_S, Supervisor, remove_remains


def test_time_in_which_the_driver_was_frozen_is_not_the_trials(
    make_space: Callable[..., Space], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(supervisor.time, "monotonic", lambda: clock.now)
    space = make_space()
    trials = resolve_trials(space)
    experiment = opening.create(tmp_path / "runs" / "small", space, trials, {})
    with listening() as stop, stop.deferred():
        driver = Supervisor(experiment, lambda config: trials[0], Console(trials, 1), stop, lambda: None, trials)
        driver.on_trial_start(0, [], SimpleNamespace(config={}))
        stop.receive(signal.SIGTERM)
        driver.on_step_end(0, [])
        assert experiment.stop_file.exists()
        clock.now += 10 * SHUTDOWN_GRACE_S  # the laptop slept; the trial has had no time to save itself
        driver.on_step_end(1, [])
        assert not driver.stopped
        for step in range(round(SHUTDOWN_GRACE_S / LONGEST_STEP_S)):
            clock.now += LONGEST_STEP_S
            driver.on_step_end(step, [])
        assert driver.stopped


def test_a_trial_that_waits_for_another_process_does_not_run(
    make_space: Callable[..., Space], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = make_space()
    trials = resolve_trials(space)
    experiment = opening.create(tmp_path / "runs" / "small", space, trials, {})
    ray_trials = [SimpleNamespace(config={"id": t.id}, pickled_error_file=None, num_failures=1) for t in trials]
    with listening() as stop, stop.deferred():
        console = Console(trials, 2)
        known = {trial.id: trial for trial in trials}
        driver = Supervisor(experiment, lambda config: known[config["id"]], console, stop, lambda: None, trials)
        for trial in ray_trials:
            driver.on_trial_start(0, [], trial)
        assert console.status().startswith("2 running · 0 waiting · 0 ended")
        driver.on_trial_recover(0, [], ray_trials[0])
        assert console.status().startswith("1 running · 1 waiting · 0 ended")
        assert driver.waiting() == 1
        stop.receive(signal.SIGINT)
        driver.on_step_end(0, [])
        assert "SIGINT: 1 trials save themselves" in capsys.readouterr().out
        driver.on_trial_complete(0, [], ray_trials[1])
        assert driver.stopped  # there is no process to wait for


def test_a_trial_that_had_no_process_while_others_saved_themselves_is_not_waited_for(
    make_space: Callable[..., Space], tmp_path: Path
) -> None:
    space = make_space()
    trials = resolve_trials(space)
    experiment = opening.create(tmp_path / "runs" / "small", space, trials, {})
    trial = SimpleNamespace(config={}, pickled_error_file=None, num_failures=1)
    with listening() as stop, stop.deferred():
        driver = Supervisor(experiment, lambda config: trials[0], Console(trials, 1), stop, lambda: None, trials)
        driver.on_trial_start(0, [], trial)
        stop.receive(signal.SIGINT)
        driver.on_step_end(0, [])
        assert not driver.stopped
        driver.on_trial_recover(0, [], trial)  # it died instead
        assert driver.stopped


def test_a_score_is_not_compared_with_those_of_all_other_trials(
    make_space: Callable[..., Space], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trials = resolve_trials(make_space(seeds="0-29"))
    looks: list[Trial] = []
    environment = Trial.environment.fget
    assert environment is not None
    monkeypatch.setattr(Trial, "environment", property(lambda trial: looks.append(trial) or environment(trial)))
    console = Console(trials, 1)
    counts = []
    for score, trial in enumerate(trials):
        looks.clear()
        console.evaluated(trial, 10, score, score)
        counts.append(len(looks))
    assert counts[-1] == counts[1]
    # The best starts again, and the next best leads.
    console.attempted_again(trials[-1], FIRST)
    assert f"best {len(trials) - 2} ({trials[-2].id})" in console.status()


def test_nothing_is_written_into_a_folder_made_in_place_of_an_experiment(
    make_space: Callable[..., Space], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = make_space()
    trials = resolve_trials(space)
    experiment = opening.create(tmp_path / "runs" / "small", space, trials, {})
    experiment.path.rename(tmp_path / "elsewhere")
    experiment.tune.mkdir(parents=True)  # as Ray does
    with listening() as stop, stop.deferred():
        driver = Supervisor(experiment, lambda config: trials[0], Console(trials, 1), stop, lambda: None, trials)
        driver.on_trial_start(0, [], SimpleNamespace(config={}))
        stop.receive(signal.SIGTERM)
        driver.on_step_end(0, [])
    assert [child.name for child in experiment.path.iterdir()] == ["tune"]
    assert "trials are not asked to stop" in capsys.readouterr().out


@pytest.mark.parametrize("left", [["tune"], ["tune", "stop"], ["stop"]])
def test_what_was_made_in_place_of_an_experiment_goes(
    left: list[str], make_space: Callable[..., Space], tmp_path: Path
) -> None:
    space = make_space()
    experiment = opening.create(tmp_path / "runs" / "small", space, resolve_trials(space), {})
    experiment.path.rename(tmp_path / "elsewhere")
    for name in left:
        (experiment.path / name).mkdir(parents=True)
    remove_remains(experiment)
    assert not experiment.path.exists()
    (tmp_path / "elsewhere").rename(experiment.path)
    remove_remains(experiment)
    assert experiment.lost() is None
