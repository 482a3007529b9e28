"""How long the longest trial of a space can be, and that a search's rungs are shares of it."""

from pathlib import Path
from typing import Any

import pytest

from msk_ray.errors import ConfigError
from msk_ray.sweep import opening
from msk_ray.sweep.budget import env_steps_budget, extreme_configs, longest_budget
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune import driver
from msk_ray.tune.__main__ import main
from msk_ray.tune.devices import Placement

RATE = {"shac.actor_lr": {"loguniform": [1e-3, 1e-2]}}


def test_env_steps_budget_of_a_growing_horizon(make_space: Any) -> None:
    # Epochs 0..19 with horizons 4, 6, 8, 8, ...: (4 + 6 + 18 × 8) × 8 worlds = 1232.
    grow = {"kind": "schedule", "start": 4, "end": 8, "epochs": 2}
    (trial,) = resolve_trials(make_space(parameters={"shac.horizon": {"grid": [grow]}}))
    assert env_steps_budget(trial.config) == 1232


def test_an_adaptive_horizon_counts_with_its_longest(make_space: Any) -> None:
    adapt = {"kind": "adaptive", "start": 4, "shortest": 2, "longest": 16, "target": 1.0}
    (trial,) = resolve_trials(make_space(parameters={"shac.horizon": {"grid": [adapt]}}))
    assert env_steps_budget(trial.config) == 8 * 20 * 16


GROW = {"label": "grow", "value": {"kind": "schedule", "start": 8, "end": 24, "epochs": 1}}
ADAPT = {"label": "adapt", "value": {"kind": "adaptive", "start": 4, "shortest": 2, "longest": 20, "target": 1.0}}


@pytest.mark.parametrize(
    ("parameters", "steps"),
    [
        ({}, 8 * 20 * 8),
        ({"shac.horizon": {"choice": [2, 16, 8]}}, 8 * 20 * 16),
        ({"shac.horizon": {"randint": [2, 32]}}, 8 * 20 * 32),
        ({"shac.horizon": {"choice": [16, GROW]}}, 8 * (8 + 19 * 24)),
        ({"shac.horizon": {"choice": [16, ADAPT]}}, 8 * 20 * 20),
        ({"trial.epochs": {"choice": [10, 40]}, "env.nworld": {"choice": [4, 32]}}, 32 * 40 * 8),
        # A whole section as a level: the longest of the two sections, with the most worlds.
        (
            {
                "shac": {"choice": [{"gamma": 0.9}, {"gamma": 0.8, "horizon": 12}]},
                "env.nworld": {"choice": [16, 8]},
            },
            16 * 20 * 12,
        ),
    ],
)
def test_the_longest_trial_a_search_may_suggest(make_space: Any, parameters: dict[str, Any], steps: int) -> None:
    space = make_space(parameters={**({} if "shac" in parameters else RATE), **parameters}, search="optuna", samples=3)
    assert longest_budget(space.file, extreme_configs(space)) == steps


def test_epochs_are_compared_by_the_most_epochs(make_space: Any) -> None:
    space = make_space(
        parameters={"trial.epochs": {"choice": [10, 40]}},
        search="optuna",
        scheduler={"kind": "asha", "time_attr": "epoch"},
    )
    assert longest_budget(space.file, extreme_configs(space)) == 40


def test_what_does_not_decide_the_length_is_not_combined(make_space: Any) -> None:
    rates = {"choice": [1e-4 * n for n in range(1, 500)]}
    space = make_space(parameters={"shac.actor_lr": rates, "shac.horizon": {"choice": [4, 8]}}, search="optuna")
    assert [config.shac.horizon for config in extreme_configs(space)] == [4, 8]


def test_rungs_of_a_search_are_shares_of_its_longest_trial(make_space: Any, tmp_path: Path) -> None:
    """The first level, 4, would give rungs of 160 and 320 env steps where a quarter of the longest trial is 1280."""
    space = make_space(
        parameters={**RATE, "shac.horizon": {"choice": [4, 32]}},
        search="optuna",
        scheduler={"kind": "asha", "grace": 0.25, "reduction": 2},
    )
    made = opening.create(tmp_path / "runs" / "search", space, [], {})
    plan = driver.Plan(made, space, [], Placement(0.0, 1), None)
    budget = driver._budget(plan)
    assert space.file.scheduler.rungs(budget) == (1280.0, 2560.0)


def test_a_search_with_a_wrong_setting_is_refused_before_it_begins(make_space: Any, tmp_path: Path) -> None:
    space = make_space(parameters={**RATE, "shac.horizon": {"choice": [4, -1]}}, search="optuna")
    with pytest.raises(ConfigError, match=r"shac\.horizon -1"):
        extreme_configs(space)
    file = tmp_path / "search.yaml"
    file.write_text("question: x\nbase: base.yaml\nsearch: optuna\nparameters: {shac.horizon: {choice: [4, -1]}}\n")
    with pytest.raises(ConfigError, match=r"shac\.horizon -1"):
        main(["--space", str(file), "--storage", str(tmp_path / "runs"), "--dry-run"])
