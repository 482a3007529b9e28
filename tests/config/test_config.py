"""Configurations: what is shipped loads; what is wrong is refused with what to write instead."""

from pathlib import Path

import pytest

from msk_ray.config import load_config, overlay, parse_config, parse_override, parse_overrides
from msk_ray.errors import ConfigError

CARTPOLE = {"env": {"name": "cartpole"}}


def test_every_shipped_config_loads(root: Path) -> None:
    files = sorted((root / "configs").rglob("*.yaml"))
    assert len(files) >= 11
    for file in files:
        load_config(file)


def test_a_config_survives_a_round_trip() -> None:
    config = parse_config({**CARTPOLE, "shac": {"horizon": {"kind": "schedule", "start": 8, "end": 32, "epochs": 10}}})
    assert parse_config(config.as_dict()) == config


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({**CARTPOLE, "shac": {"horizn": 3}}, "shac.horizn: unknown key; did you mean 'horizon'?"),
        ({**CARTPOLE, "phsics": {}}, "did you mean 'physics'?"),
        ({"env": {"name": "ant", "reward": {"uup": 1.0}}}, "env.reward.uup: unknown key; did you mean 'up'?"),
        ({"env": {"name": "ant", "up": 1.0}}, "env.up: unknown key; write env.reward.up"),
        ({**CARTPOLE, "horizon": 4}, "horizon: unknown key; write shac.horizon"),
        ({**CARTPOLE, "shac": {"gamma": 3}}, "shac.gamma: Input should be less than or equal to 1, not 3"),
        ({**CARTPOLE, "physics": {"timestep": 0.003}}, "does not divide env.control_timestep"),
        ({**CARTPOLE, "physics": {"timestep": 1 / 240, "substeps": 3}}, "disagree"),
        ({"env": {"name": "ant"}, "physics": {"variant": "soft"}}, "write one of matched,"),
        ({**CARTPOLE, "physics": {"solref": [0.1, 1]}}, "physics.solref: env cartpole does not read it; leave it out"),
        ({"env": {"name": "ant"}, "physics": {"cone": "pyramidal", "solreffriction": [1, 1]}}, "cone: elliptic"),
        (
            {"env": {"name": "swimmer"}},
            "env.name: unknown name 'swimmer'; write cartpole, ant, hopper, cheetah, humanoid, g1_tracking, "
            "g1_velocity, go1_velocity, go1_velocity_rough, myoleg, myoleg26, myosuite_walk or package.module:Class",
        ),
        ({**CARTPOLE, "shac": {"critic_batches": 7}}, "critic_batches 7 must divide"),
        ({}, "env: missing"),
    ],
)
def test_a_fault_is_named_on_one_line(data: dict, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(data)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_schedules_that_training_ends_before_are_named() -> None:
    """Not refused, because epochs can be added to a trial."""
    assert load_config("g1_velocity").unfinished == []
    (line,) = load_config("g1_velocity", ["trial.epochs=450", "env.command_schedule.end=900"]).unfinished
    assert line.startswith("env.command_schedule.end is epoch 900, but training ends at trial.epochs, 450")
    (line,) = load_config("ant", ["curriculum={start: {solref: [0.05, 1.0]}, epochs: 100000}"]).unfinished
    assert line.startswith("curriculum.epochs is epoch 100000")


def test_overrides_reach_nested_settings() -> None:
    key, value = parse_override("shac.horizon={kind: schedule, start: 4, end: 8, epochs: 2}")
    data = overlay(CARTPOLE, {key: value, "env.nworld": 16})
    config = parse_config(data)
    assert config.env.nworld == 16
    assert config.shac.horizon.end == 8
    assert CARTPOLE == {"env": {"name": "cartpole"}}, "the original is left alone"


def test_an_override_without_a_value_is_refused() -> None:
    with pytest.raises(ConfigError, match="write key=value"):
        parse_override("shac.horizon")


def test_extends_lays_one_file_over_another(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("env: {name: ant, nworld: 32, reward: {up: 0.5}}\n")
    (tmp_path / "child.yaml").write_text("extends: base.yaml\nenv: {reward: {up: 0.2}}\n")
    config = load_config(tmp_path / "child.yaml")
    assert (config.env.nworld, config.env.reward.up) == (32, 0.2)
    (tmp_path / "of_shipped.yaml").write_text("extends: cartpole\nenv: {nworld: 3}\n")
    assert load_config(tmp_path / "of_shipped.yaml") == load_config("cartpole", ["env.nworld=3"])
    (tmp_path / "grandchild.yaml").write_text("extends: child.yaml\n")
    with pytest.raises(ConfigError, match="extends another file"):
        load_config(tmp_path / "grandchild.yaml")


def test_a_missing_file_lists_its_neighbours(tmp_path: Path) -> None:
    (tmp_path / "ant.yaml").write_text("")
    with pytest.raises(ConfigError, match=r"no such file.*holds: ant"):
        load_config(tmp_path / "aunt.yaml")


@pytest.mark.parametrize("text", ["- 1\n- 2\n", "a: [1,\n", ""])
def test_a_file_that_is_no_mapping_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"bad\.yaml"):
        load_config(path)


def test_substeps_follow_from_either_setting() -> None:
    assert parse_config({**CARTPOLE, "physics": {"timestep": 1 / 480}}).physics.resolve_substeps(1 / 60) == 8
    assert parse_config({**CARTPOLE, "physics": {"substeps": 5}}).physics.resolve_substeps(1 / 60) == 5
    assert parse_config(CARTPOLE).physics.resolve_substeps(1 / 60) == 4


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("shac.horizon=half", "shac.horizon: Input should be a valid integer"),
        (
            "shac.horizon={kind: schedule, start: 4, ende: 8, epochs: 2}",
            "shac.horizon.ende: unknown key; did you mean 'end'?",
        ),
        (
            "shac.horizon={kind: adaptive, start: 4, target: 8, longset: 9}",
            "shac.horizon.longset: unknown key; did you mean 'longest'?",
        ),
        (
            "shac.horizon={kind: contact, start: 4, contact: 8, longset: 9}",
            "shac.horizon.longset: unknown key; did you mean 'longest'?",
        ),
        (
            "shac.horizon={kind: contact, start: 4, contact: -8}",
            "shac.horizon.contact: Input should be greater than 0",
        ),
        (
            "shac.horizon={kind: adaptive, start: 2, target: 8}",
            "shac.horizon: start 2 must be between shortest 4 and longest 64",
        ),
        ("curriculum={start: {}, epochs: 3}", "write solref, solreffriction or both"),
        ("curriculum={start: {solref: [0.1, 1]}, epochs: 3}", "curriculum: cartpole has no contacts"),
        ("shac.entropy={coefficient: 0}", "shac.entropy.coefficient: Input should be greater than 0"),
        ("shac.reward_scale=1.0e+308", "shac.reward_scale: Input should be less than or equal to 1000000, not 1e+308"),
        ("shac.actor_lr=1.0e-320", "shac.actor_lr: Input should be greater than or equal to 0.0000000001, not 1e-320"),
        ("shac.entropy={coefficient: 1.0e-320}", "shac.entropy.coefficient: Input should be 0 or between 1e-30 and"),
        ("env.reward.pole_angle_penalty=1.0e+300", "env.reward.pole_angle_penalty: Input should be 0 or between"),
    ],
)
def test_faults_in_what_adapts_are_named(override, message):
    with pytest.raises(ConfigError) as caught:
        parse_config(overlay(CARTPOLE, parse_overrides([override])))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
