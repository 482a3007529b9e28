"""One rule for laying settings over settings, the same from `train --set`, `tune --set`, `extends` and spaces."""

from pathlib import Path
from typing import Any

import pytest

from msk_ray.config import combine, dump_yaml, load_config, merge, overlay, parse_overrides
from msk_ray.errors import ConfigError
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune import __main__ as tune
from msk_ray.tune.options import read_options

ADAPTIVE = {"kind": "adaptive", "start": 8, "target": 60.0}
SCHEDULE = {"kind": "schedule", "start": 4, "end": 16, "epochs": 50}
BASE: dict[str, Any] = {
    "env": {"name": "cartpole", "nworld": 8},
    "shac": {"horizon": {**ADAPTIVE, "longest": 32}, "entropy": {"coefficient": 0.02}},
}


def _horizon(over: Any) -> Any:
    return overlay(BASE, {"shac.horizon": over})["shac"]["horizon"]


def test_a_mapping_keeps_what_it_does_not_name() -> None:
    assert overlay(BASE, {"shac.entropy": {"target": 0.5}})["shac"]["entropy"] == {"coefficient": 0.02, "target": 0.5}
    assert overlay(BASE, {"shac": {"entropy": {"target": 0.5}}}) == overlay(BASE, {"shac.entropy.target": 0.5})


def test_anything_else_replaces() -> None:
    assert overlay(BASE, {"shac.entropy": None})["shac"]["entropy"] is None
    assert _horizon(16) == 16
    assert overlay({"shac": {"horizon": 16}}, {"shac.horizon": SCHEDULE})["shac"]["horizon"] == SCHEDULE
    assert overlay({"actor": {"hidden": [8, 4]}}, {"actor.hidden": [2]})["actor"]["hidden"] == [2]


def test_kinds_of_mapping_do_not_mix() -> None:
    assert _horizon(SCHEDULE) == SCHEDULE
    assert overlay({"shac": {"horizon": SCHEDULE}}, {"shac.horizon": ADAPTIVE})["shac"]["horizon"] == ADAPTIVE
    other = overlay(BASE, {"env": {"name": "ant"}})
    assert other["env"] == {"name": "ant"}
    assert overlay(BASE, {"env": {"name": "cartpole", "nworld": 4}})["env"] == {"name": "cartpole", "nworld": 4}


def test_mappings_of_the_same_kind_do() -> None:
    assert _horizon({"start": 4}) == {**ADAPTIVE, "longest": 32, "start": 4}
    assert overlay({"shac": {"horizon": SCHEDULE}}, {"shac.horizon": {"epochs": 9}})["shac"]["horizon"] == {
        **SCHEDULE,
        "epochs": 9,
    }


def test_a_key_reaches_into_a_section_that_is_not_there_yet() -> None:
    for absent in ({}, {"shac": {}}, {"shac": {"entropy": None}}, {"shac": None}):
        assert overlay(absent, {"shac.entropy.target": 0.5})["shac"]["entropy"] == {"target": 0.5}
    with pytest.raises(ConfigError, match=r"shac\.gamma\.x: gamma is a value"):
        overlay({"shac": {"gamma": 0.9}}, {"shac.gamma.x": 1})


def test_nothing_is_shared_with_what_it_came_from() -> None:
    over: dict[str, Any] = {"shac.entropy": {"target": 0.5}}
    made = overlay(BASE, over)
    made["shac"]["entropy"]["target"] = 1.0
    made["shac"]["horizon"]["start"] = 1
    made["env"]["nworld"] = 1
    assert over == {"shac.entropy": {"target": 0.5}}
    assert BASE["shac"]["horizon"]["start"] == 8
    assert BASE["env"]["nworld"] == 8


def test_what_is_said_last_holds() -> None:
    assert parse_overrides(["a.b={x: 1}", "a.b.x=2", "a.b={y: 3}"]) == {"a.b.x": 2, "a.b": {"x": 1, "y": 3}}
    assert list(combine({"a": 1, "b": 2}, [("a", 3)])) == ["b", "a"]
    assert overlay({}, parse_overrides(["a.b={x: 1}", "a.b.x=2", "a.b={x: 5}"])) == {"a": {"b": {"x": 5}}}


_ENTROPY = {"coefficient": 0.02, "target": 0.5, "normalize": False}
CASES: list[tuple[list[str], str, Any]] = [
    (["shac.entropy={target: 0.5}"], "entropy", _ENTROPY),
    (
        ["shac.entropy={target: 0.5}", "shac.entropy={coefficient: 0.1}"],
        "entropy",
        _ENTROPY | {"coefficient": 0.1},
    ),
    (
        ["shac={entropy: {target: 0.5}}"],
        "entropy",
        {"coefficient": 0.02, "target": 0.5, "normalize": False},
    ),
    (["shac.entropy=null"], "entropy", None),
    (
        ["shac.horizon={start: 4}"],
        "horizon",
        {**ADAPTIVE, "start": 4, "shortest": 4, "longest": 32},
    ),
    (["shac.horizon={kind: schedule, start: 4, end: 16, epochs: 50}"], "horizon", SCHEDULE),
    (
        ["shac.horizon.longest=16"],
        "horizon",
        {**ADAPTIVE, "shortest": 4, "longest": 16},
    ),
    (["shac.horizon=16"], "horizon", 16),
]


@pytest.mark.parametrize(("texts", "setting", "expected"), CASES)
def test_every_way_in_means_the_same(
    texts: list[str], setting: str, expected: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`train --set`, `tune --set`, a space's overrides, a parameter's value, a variant, and a file that extends."""
    (tmp_path / "base.yaml").write_text(dump_yaml(BASE))
    values = parse_overrides(texts)
    configs = {"train": load_config(tmp_path / "base.yaml", texts)}
    (tmp_path / "child.yaml").write_text(dump_yaml({"extends": "base.yaml", **overlay({}, values)}))
    configs["extends"] = load_config(tmp_path / "child.yaml")
    data: dict[str, Any] = {"question": "?", "base": "base.yaml"}
    spaces: dict[str, dict[str, Any]] = {
        "overrides": {"overrides": values},
        "variant": {"ablate": {"variants": {"this": values}}},
    }
    if len(values) == 1:
        ((key, value),) = values.items()
        spaces["parameter"] = {"parameters": {key: {"grid": [{"label": "this", "value": value}]}}}
    for name, changes in spaces.items():
        configs[name] = resolve_trials(parse_space(data | changes, tmp_path / "small.yaml"))[-1].config
    (tmp_path / "small.yaml").write_text(dump_yaml(data))
    args = ["--space", str(tmp_path / "small.yaml"), *(word for text in texts for word in ("--set", text))]
    configs["tune"] = resolve_trials(tune._read_space(read_options(args), {}))[0].config
    assert {name: config.as_dict()["shac"][setting] for name, config in configs.items()} == dict.fromkeys(
        configs, expected
    )


def test_set_is_laid_over_a_spaces_own_override(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("env: {name: cartpole}\n")
    data = {"question": "?", "base": "base.yaml", "overrides": {"shac.entropy": {"coefficient": 0.3}}}
    (tmp_path / "small.yaml").write_text(dump_yaml(data))
    args = read_options(["--space", str(tmp_path / "small.yaml"), "--set", "shac.entropy={target: 0.5}"])
    (trial,) = resolve_trials(tune._read_space(args, {}))
    assert trial.config.shac.entropy is not None
    assert (trial.config.shac.entropy.coefficient, trial.config.shac.entropy.target) == (0.3, 0.5)


def test_merge_is_the_same_rule() -> None:
    assert merge({"shac": {"horizon": SCHEDULE}}, {"shac": {"horizon": ADAPTIVE}}) == {"shac": {"horizon": ADAPTIVE}}
