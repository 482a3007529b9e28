"""Gauges of trials: what is set, under which names and tags."""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from msk_ray.experiment.outcomes import Ending, Outcome, write_ending
from msk_ray.sweep import opening
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune import gauges


class FakeGauge:
    """Remembers the newest value for each set of tags."""

    made: dict[str, "FakeGauge"]

    def __init__(self, name: str, description: str, tag_keys: tuple[str, ...]) -> None:
        self.keys, self.default, self.values = set(tag_keys), dict[str, str](), dict[tuple[str, ...], float]()
        FakeGauge.made[name] = self

    def set_default_tags(self, tags: dict[str, str]) -> None:
        self.default = tags

    def set(self, value: float, tags: dict[str, str] | None = None) -> None:
        given = self.default | (tags or {})
        assert set(given) == self.keys
        assert all(text.isascii() for text in given.values())
        self.values[tuple(given[key] for key in ("trial", "state") if key in given)] = value


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> dict[str, FakeGauge]:
    FakeGauge.made = {}
    monkeypatch.setattr(gauges, "Gauge", FakeGauge)
    return FakeGauge.made


def test_figures_of_a_trial(fake: dict[str, FakeGauge], make_space: Any) -> None:
    trial = resolve_trials(make_space())[0]
    gauges.TrialGauges("e", trial).show({"epoch": 3, "eval/score": 7.5, "time/rollout_s": 1.0})
    assert {name: list(gauge.values.values()) for name, gauge in fake.items() if gauge.values} == {
        "msk_ray_epoch": [3],
        "msk_ray_score": [7.5],
    }
    assert set(fake) == set(gauges.FIGURES)


def test_a_value_is_set_again_and_again_until_it_is_dropped(
    fake: dict[str, FakeGauge], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray serves a value for 20 s after it was set and no longer."""
    monkeypatch.setattr(gauges, "REPEAT_S", 0.01)
    gauge: Any = FakeGauge("g", "", ("trial",))
    kept = gauges.LastingGauges()
    kept.set(gauge, 1, {"trial": "a"})
    kept.set(gauge, 2, {"trial": "a"})
    kept.set(gauge, 3, {"trial": "b"})
    for _ in range(2):
        gauge.values.clear()
        while gauge.values != {("a",): 2, ("b",): 3}:
            time.sleep(0.01)
    kept.drop(gauge, {"trial": "b"})
    assert gauge.values["b",] == 0
    gauge.values.clear()
    while gauge.values != {("a",): 2}:
        time.sleep(0.01)
    kept.close()
    gauge.values.clear()
    time.sleep(0.05)
    assert gauge.values == {}


def test_the_state_of_a_trial_is_the_only_one_at_1(fake: dict[str, FakeGauge], make_space: Any, tmp_path: Path) -> None:
    space = make_space()
    trials = resolve_trials(space)
    experiment = opening.create(tmp_path / "e", space, trials, {})
    by_id = {trial.id: trial for trial in trials}
    state = gauges.StateGauge(experiment, trials, lambda config: by_id[config["id"]])
    values = fake[gauges.STATE].values

    def now(trial: Any) -> list[str]:
        return [key[1] for key, value in values.items() if key[0] == trial.id and value == 1]

    first, second = trials
    ray_trial = SimpleNamespace(config={"id": first.id})
    assert now(first) == now(second) == ["waiting"]
    state.on_trial_start(0, [], ray_trial)
    assert now(first) == ["running"]
    state.on_trial_recover(0, [], ray_trial)  # its process died
    assert now(first) == ["waiting"]
    state.on_trial_start(0, [], ray_trial)
    experiment.trial_folder(first.id).mkdir(parents=True)
    write_ending(experiment.trial_folder(first.id), Ending(Outcome.NONFINITE, "nan"))
    state.on_trial_complete(0, [], ray_trial)
    assert now(first) == ["nonfinite"]
    assert now(second) == ["waiting"]
