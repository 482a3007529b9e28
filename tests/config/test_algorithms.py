"""Which algorithm learns, and whose settings a trial has."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from msk_ray.config import Config, dump_yaml, load_config, parse_config, parse_recorded
from msk_ray.errors import ConfigError
from msk_ray.sweep.budget import env_steps_budget, extreme_configs
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials, trial_id

BASE: dict[str, Any] = {
    "env": {"name": "cartpole", "nworld": 8},
    "shac": {"horizon": 8},
    "ppo": {"steps": 16},
    "actor": {"hidden": [16], "log_std": -0.5},
}
OUTSIDE = """
from msk_ray.config import AlgorithmSettings
class Gains(AlgorithmSettings):
    gain: float = 1.0
class Walk:
    Settings = Gains
class Bare:
    pass
"""


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module with algorithms, as far as their settings go."""
    (tmp_path / "gaits_outside.py").write_text(OUTSIDE)
    monkeypatch.syspath_prepend(tmp_path)
    return "gaits_outside"


def ppo(**changes: Any) -> Config:
    return parse_config(BASE | {"algorithm": {"name": "ppo"}} | changes)


def test_a_trial_has_the_settings_of_its_own_algorithm_alone() -> None:
    shac, other = parse_config(BASE), ppo()
    assert (shac.algorithm_settings, other.algorithm_settings) == (shac.shac, other.ppo)
    assert (shac.shac.horizon, other.ppo.steps, other.shac.horizon) == (8, 16, 32)
    assert {"shac", "ppo"} & set(shac.as_dict()) == {"shac"}
    assert {"shac", "ppo"} & set(other.as_dict()) == {"ppo"}
    assert other.as_dict()["algorithm"] == {"name": "ppo"}
    assert shac.as_dict()["actor"]["log_std"] == -0.5
    assert not {"log_std", "state_std", "output_gain"} & set(other.as_dict()["actor"])
    assert not {"backward", "substep_grad_clip", "fd"} & set(other.as_dict()["physics"])
    for config in (shac, other):
        assert parse_config(config.as_dict()) == config
        assert parse_recorded(config.as_dict(), "again") == config
    assert trial_id(other) == trial_id(ppo(shac={"horizon": 4}, physics={"backward": "fd_jacobian"}))
    assert trial_id(shac) == trial_id(parse_config({key: BASE[key] for key in ("env", "shac", "actor")}))
    assert trial_id(shac) != trial_id(other)


def test_a_section_that_is_dropped_is_still_checked() -> None:
    with pytest.raises(ConfigError, match=r"ppo\.stepps: unknown key; did you mean 'steps'"):
        parse_config(BASE | {"ppo": {"stepps": 4}})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithm": {"name": "pppo"}}, "algorithm.name: unknown name 'pppo'; did you mean 'ppo'"),
        ({"algorithm": {"name": []}}, "algorithm.name: Input should be a valid string"),
        ({"algorithm": {"nam": "ppo"}}, "algorithm.nam: unknown key; did you mean 'name'"),
        ({"algorithm": {"settings": {"horizon": 4}}}, "algorithm.settings: the settings of shac .* write shac.horizon"),
        ({"algorithm": {"name": "no_such_module:Walk"}}, "algorithm.name: no module 'no_such_module'"),
        ({"algorithm": {"name": "gaits_outside:Walc"}}, "has no 'Walc'; did you mean 'Walk'"),
        ({"algorithm": {"name": "gaits_outside:Bare"}}, "declares no settings: write .class Settings"),
        (
            {"algorithm": {"name": "gaits_outside:Walk", "settings": {"gian": 2}}},
            "algorithm.settings.gian: unknown key; did you mean 'gain'",
        ),
        ({"algorithm": {"name": "ppo"}, "ppo": {"minibatches": 7}}, "ppo.minibatches 7 must divide ppo.steps"),
        ({"algorithm": {"name": "ppo"}, "critic": {"hidden": []}}, r"write critic.hidden: \[64, 64\]"),
        (
            {"algorithm": {"name": "ppo"}, "ppo": {"lr_schedule": "constant", "desired_kl": 0.1}},
            "ppo.desired_kl: nothing reads it while ppo.lr_schedule is constant; leave it out",
        ),
    ],
)
@pytest.mark.usefixtures("outside")
def test_faults_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_config(BASE | changes)


def test_ppo_has_no_contact_curriculum() -> None:
    env = {"name": "ant", "nworld": 2}
    curriculum = {"start": {"solref": [0.1, 1.0]}, "epochs": 2}
    with pytest.raises(ConfigError, match="curriculum: ppo trains without one; write curriculum: null"):
        ppo(env=env, curriculum=curriculum)


def test_an_algorithm_from_outside_has_settings_of_its_own(outside: str) -> None:
    config = parse_config(BASE | {"algorithm": {"name": f"{outside}:Walk", "settings": {"gain": 2}}})
    assert config.algorithm_settings.model_dump() == {"gain": 2.0}
    assert config.as_dict()["algorithm"] == {"name": "gaits_outside:Walk", "settings": {"gain": 2.0}}
    assert not {"shac", "ppo"} & set(config.as_dict())
    assert parse_config(config.as_dict()) == config
    with pytest.raises(ConfigError, match="Gains does not say how many env steps an epoch takes"):
        env_steps_budget(config)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["ppo.steps=8"], "--set ppo.steps: nothing reads it while algorithm.name is shac; leave it out"),
        (["algorithm.name=ppo", "shac={gamma: 0.9}"], "--set shac.gamma: nothing reads it while algorithm.name is ppo"),
        (["algorithm.name=ppo", "physics.fd.eps_ctrl=1.0"], "--set physics.fd.eps_ctrl: nothing reads it"),
        (["algorithm.name=ppo", "actor.log_std=0.0"], "--set actor.log_std: nothing reads it"),
    ],
)
def test_what_is_said_of_the_trial_is_not_dropped(overrides: list[str], message: str, tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(dump_yaml(BASE))
    with pytest.raises(ConfigError, match=message):
        load_config(tmp_path / "base.yaml", overrides)
    assert load_config(tmp_path / "base.yaml", ["algorithm.name=ppo", "ppo.steps=8"]).ppo.steps == 8


def space(folder: Path, **changes: Any) -> Any:
    (folder / "base.yaml").write_text(dump_yaml(BASE))
    return parse_space({"question": "?", "base": "base.yaml"} | changes, folder / "small.yaml")


BOTH = {"algorithm.name": {"grid": ["shac", "ppo"]}}


def test_a_space_sweeps_algorithms_with_the_settings_of_each(tmp_path: Path) -> None:
    made = space(tmp_path, parameters=BOTH, overrides={"ppo.clip": 0.3, "shac.gamma": 0.9}, seeds="0-1")
    trials = resolve_trials(made)
    assert [(t.variant, t.seed) for t in trials] == [
        ("algorithm=shac", 0), ("algorithm=ppo", 0), ("algorithm=shac", 1), ("algorithm=ppo", 1),
    ]  # fmt: skip
    assert (trials[0].config.shac.gamma, trials[1].config.ppo.clip) == (0.9, 0.3)
    assert [env_steps_budget(trial.config) for trial in trials[:2]] == [8 * 500 * 8, 8 * 500 * 16]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"overrides": {"ppo.clip": 0.3}}, "small: overrides: ppo.clip: nothing reads it while algorithm.name is shac"),
        ({"parameters": {"ppo.clip": {"grid": [0.1, 0.2]}}}, "parameters: ppo.clip: nothing reads it"),
        ({"ablate": {"variants": {"a": {"ppo.clip": 0.1}}}}, "ablate: ppo.clip: nothing reads it"),
        ({"parameters": BOTH | {"ppo.clip": {"grid": [0.1, 0.2]}}}, "come out as the same trial"),
    ],
)
def test_a_space_sets_nothing_that_no_trial_reads(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        resolve_trials(space(tmp_path, **changes))


def test_a_search_that_chooses_the_algorithm_is_checked_for_each(tmp_path: Path) -> None:
    choice = {"algorithm.name": {"choice": ["shac", "ppo"]}, "ppo.clip": {"uniform": [0.1, 0.3]}}
    configs = extreme_configs(space(tmp_path, parameters=choice, search="optuna"))
    assert {config.algorithm.name for config in configs} == {"shac", "ppo"}
    only = {"shac.gamma": {"uniform": [0.9, 0.99]}}
    with pytest.raises(ConfigError, match=r"overrides: ppo\.clip: nothing reads it"):
        extreme_configs(space(tmp_path, parameters=only, overrides={"ppo.clip": 0.1}, search="optuna"))


def test_settings_are_read_without_torch(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(dump_yaml(BASE | {"algorithm": {"name": "ppo"}}))
    code = f"""
import sys
from pathlib import Path
from msk_ray.config import load_config
assert load_config(Path({str(tmp_path / "base.yaml")!r})).ppo.steps == 16
assert not {{"torch", "rsl_rl"}} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_ppo_has_no_epochs_to_record() -> None:
    with pytest.raises(ConfigError, match=r"execution\.capture: nothing reads it while algorithm\.name is ppo"):
        load_config("cartpole", ["algorithm.name=ppo", "execution.capture=off"])
