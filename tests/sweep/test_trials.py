"""From a space to its trials."""

from pathlib import Path
from typing import Any

import pytest

from msk_ray.config import dump_yaml, overlay
from msk_ray.errors import ConfigError
from msk_ray.sweep.smoke import cover, shrink
from msk_ray.sweep.space import find_space, load_space, parse_seeds
from msk_ray.sweep.trials import find_trial, resolve_trials


def test_grid_is_a_product_with_seeds_outermost(make_space: Any) -> None:
    space = make_space(
        parameters={"shac.actor_lr": {"grid": [0.01, 0.001]}, "shac.gamma": {"grid": [0.9, 0.99]}}, seeds="0-1"
    )
    trials = resolve_trials(space)
    assert [(t.seed, t.config.shac.actor_lr, t.config.shac.gamma) for t in trials] == [
        (seed, rate, gamma) for seed in (0, 1) for rate in (0.01, 0.001) for gamma in (0.9, 0.99)
    ]
    assert trials[1].variant == "actor_lr=0.01, gamma=0.99"


def test_ids_depend_on_content_alone(make_space: Any) -> None:
    first = resolve_trials(make_space(question="one"))
    again = resolve_trials(make_space(question="two", parameters={"shac.actor_lr": {"grid": [0.001, 0.01]}}))
    assert [t.id for t in first] == [t.id for t in reversed(again)]
    assert len({t.id for t in resolve_trials(make_space(seeds="0-9"))}) == 20


def test_samples_are_repeatable_and_growing_keeps_the_earlier_ones(make_space: Any) -> None:
    parameters = {"shac.actor_lr": {"loguniform": [1e-4, 1e-2]}, "shac.gamma": {"grid": [0.9, 0.99]}}
    few = resolve_trials(make_space(parameters=parameters, samples=2))
    many = resolve_trials(make_space(parameters=parameters, samples=5))
    assert len(few) == 4
    assert [t.id for t in many[:4]] == [t.id for t in few]
    other = resolve_trials(make_space(parameters=parameters, samples=2, sample_seed=1))
    assert not {t.id for t in other} & {t.id for t in few}


def test_ablation_changes_one_factor_at_a_time(make_space: Any) -> None:
    ablate = {
        "baseline": {"shac.gamma": 0.9, "shac.lam": 0.5},
        "variants": {"far": {"shac.gamma": 0.99}, "both": {"shac.lam": 0.9, "shac.actor_lr": 0.1}},
    }
    trials = resolve_trials(make_space(parameters={}, ablate=ablate))
    assert [(t.variant, t.config.shac.gamma, t.config.shac.lam) for t in trials] == [
        ("baseline", 0.9, 0.5),
        ("far", 0.99, 0.5),
        ("both", 0.9, 0.9),
    ]


def test_grids_repeat_an_ablation(make_space: Any) -> None:
    ablate = {"variants": {"far": {"shac.gamma": 0.999}}}
    grid = {"shac.horizon": {"grid": [4, 8]}}
    trials = resolve_trials(make_space(parameters=grid, ablate=ablate))
    assert [(t.variant, t.config.shac.horizon, t.config.shac.gamma) for t in trials] == [
        ("horizon=4, baseline", 4, 0.99),
        ("horizon=4, far", 4, 0.999),
        ("horizon=8, baseline", 8, 0.99),
        ("horizon=8, far", 8, 0.999),
    ]
    with pytest.raises(ConfigError, match=r"'shac\.horizon' and 'far' both set shac\.horizon"):
        resolve_trials(make_space(parameters=grid, ablate={"variants": {"far": {"shac.horizon": 16}}}))
    with pytest.raises(ConfigError, match="beside it write only grids"):
        make_space(parameters={"shac.gamma": {"uniform": [0.9, 0.99]}}, ablate=ablate)
    with pytest.raises(ConfigError, match="4 variants × 1 seeds are 4 trials"):
        make_space(parameters=grid, ablate=ablate, max_trials=3)


def test_a_mapping_is_laid_over_a_section_and_replaces_a_number() -> None:
    settings = {"shac": {"horizon": 32, "gamma": 0.9}}
    assert overlay(settings, {"shac": {"gamma": 0.5}})["shac"] == {"horizon": 32, "gamma": 0.5}
    schedule = {"start": 8, "end": 32, "epochs": 10}
    assert overlay(settings, {"shac.horizon": schedule})["shac"] == {"horizon": schedule, "gamma": 0.9}
    with pytest.raises(ConfigError, match="gamma is a value"):
        overlay(settings, {"shac.gamma.x": 1})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameters": {"shac.actor_lrr": {"grid": [1]}}}, "did you mean 'actor_lr'"),
        ({"parameters": {"shac.gamma": {"uniform": [0.5, 1.5]}}}, "gamma uniform at its end 1.5"),
        ({"parameters": {"shac.gamma": {"grid": [0.9, 2.0]}}}, "trial 1 .*less than or equal to 1"),
        ({"parameters": {"shac.gamma": {"grid": [0.9, 0.9]}}}, "same trial"),
        ({"parameters": {"shac.gamma": {"grid": [0.9, 0.90000001]}}}, "both shown as 0.9; give each a label"),
        ({"parameters": {"shac": {"grid": [{"gamma": 0.9}]}, "shac.gamma": {"grid": [0.8]}}}, "both set shac.gamma"),
        ({"parameters": {"trial.seed": {"grid": [1]}}}, r"parameters\.trial\.seed: seeds .* write seeds"),
        ({"parameters": {"trial": {"grid": [{"seed": 1}]}}}, r"parameters\.trial\.seed"),
        ({"overrides": {"trial.seed": 1}}, r"overrides\.trial\.seed: seeds have their own section"),
        ({"overrides": {"trial": {"seed": 1}}}, r"overrides\.trial\.seed"),
        ({"parameters": {}, "ablate": {"variants": {"a": {"trial.seed": 1}}}}, r"ablate\.variants\.a\.trial\.seed"),
        ({"overrides": {"shac.gamm": 1}}, "did you mean 'gamma'"),
        ({"seeds": "4-0"}, "runs backwards; write 0-4"),
        ({"seeds": "a"}, "whole numbers"),
        ({"base": "nowhere.yaml"}, "no such config file"),
        ({"schedular": {}}, "did you mean 'scheduler'"),
        ({"scheduler": {"knd": "asha"}}, "did you mean 'kind'"),
        ({"scheduler": {"kind": "asha", "grace": 2}}, "scheduler.grace"),
        ({"samples": 3}, "nothing is drawn"),
        ({"search": "optuna"}, "optuna cannot enumerate"),
        ({"objectives": {"eval/length": "maximize"}}, "search: random looks for none; write search: optuna"),
        ({"search": "optuna", "objectives": {"eval/length": "up"}}, "objectives"),
        ({"scheduler": {"kind": "pbt"}}, "pbt needs a parameter with a range"),
        ({"scheduler": {"kind": "asha", "time_attr": "seconds"}}, "needs stop.wall_time_s"),
    ],
)
def test_faults_are_one_line(make_space: Any, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        resolve_trials(make_space(**changes))
    assert "\n" not in str(caught.value)


def test_seeds() -> None:
    assert parse_seeds("0-2,7, 1") == (0, 1, 2, 7)
    assert parse_seeds(3) == (3,)
    assert parse_seeds([4, 2]) == (4, 2)


def test_find_trial(make_space: Any) -> None:
    trials = resolve_trials(make_space())
    assert find_trial(trials, "1") is trials[1]
    assert find_trial(trials, trials[0].id[:6]) is trials[0]
    with pytest.raises(ConfigError, match="no trial 'walker'"):
        find_trial(trials, "walker")


def test_cover_shows_every_level_with_few_trials(make_space: Any) -> None:
    space = make_space(
        parameters={"shac.actor_lr": {"grid": [0.01, 0.001, 0.0001]}, "shac.gamma": {"grid": [0.9, 0.99]}}, seeds="0-4"
    )
    trials = resolve_trials(space)
    chosen = cover(trials)
    assert len(chosen) == 3
    assert {pair for t in chosen for pair in t.changed.items()} == {p for t in trials for p in t.changed.items()}


def test_smoke_is_short_and_keeps_horizons_apart(make_space: Any) -> None:
    space = make_space(parameters={"shac.horizon": {"grid": [16, 32]}})
    trials = shrink(space, resolve_trials(space))
    assert [(t.config.shac.horizon, t.epochs, t.config.env.nworld) for t in trials] == [(4, 3, 8), (8, 3, 8)]


def test_smoke_of_variants_that_become_equal_adds_a_seed(make_space: Any) -> None:
    # Horizons 4 and 8 are both shortened to 2.
    space = make_space(parameters={"shac.horizon": {"grid": [4, 8]}}, seeds="0-4")
    trials = shrink(space, resolve_trials(space))
    assert [(t.config.shac.horizon, t.seed) for t in trials] == [(2, 0), (2, 1)]


def test_shipped_spaces_resolve(root: Any) -> None:
    names = sorted(path.stem for path in (root / "tune_spaces").glob("*.yaml"))
    assert {"cartpole_smoke", "ant_ablate", "ant_horizon", "ant_lr", "ant_softness", "ant_reward"} <= set(names)
    assert len(names) <= 12, "finished questions are kept in lab/"
    for name in names:
        space = load_space(find_space(name))
        trials = resolve_trials(space)
        assert len(trials) >= 3, name
        assert 2 <= len(shrink(space, trials)) <= 8, name
        assert (root / "tune_spaces" / f"{name}.yaml").read_text().startswith("# "), name


@pytest.mark.parametrize(
    "text",
    [
        "overrides: {5: 64}",
        "parameters: {on: {grid: [1, 2]}}",
        "ablate: {variants: {small: {5: 1}}}",
        "ablate: {baseline: {null: 1}, variants: {small: {shac.gamma: 0.9}}}",
        "smoke: {overrides: {1.5: 1}}",
    ],
)
def test_a_key_that_is_no_text_is_refused_by_name(text: str, space_data: dict[str, Any], tmp_path: Path) -> None:
    space_data.pop("parameters")
    path = tmp_path / "keys.yaml"
    path.write_text(dump_yaml(space_data) + text)
    with pytest.raises(ConfigError, match=r"keys\.yaml: key '[^']*' is [a-z ]* in YAML, not a name; write a name"):
        load_space(path)
