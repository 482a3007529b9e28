"""What version 0.2 wrote is read by this one: an experiment of two trials, the second killed after its fourth epoch."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from msk_ray import status, train
from msk_ray.cli import run
from msk_ray.config import changed_settings, dump_yaml, load_config, parse_config, parse_recorded, read_yaml
from msk_ray.config.recorded import current_settings, current_space, current_values
from msk_ray.config.sections import Section
from msk_ray.errors import ConfigError
from msk_ray.evaluate import __main__ as evaluate
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import read_metrics
from msk_ray.experiment.outcomes import Outcome
from msk_ray.experiment.trial import trial_id
from msk_ray.report import __main__ as report
from msk_ray.signals import RESUMABLE
from msk_ray.sweep.rules.stopping import StopSpec
from msk_ray.sweep.space import load_space
from msk_ray.sweep.trials import resolve_trials, with_recorded_ids
from msk_ray.training import Trainer
from msk_ray.training.policy import load_policy
from msk_ray.tune import __main__ as tune
from msk_ray.tune import driver
from msk_ray.tune.trial_run import Hooks, run_trial
from msk_ray.visualize import __main__ as visualize

RECORDED = Path(__file__).parents[1] / "fixtures" / "version_0_2"
IDS = ["818b0ef0", "e64db494"]


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """A copy to work on."""
    return Path(shutil.copytree(RECORDED, tmp_path / "recorded"))


def test_recorded_trials_map_to_todays_ids() -> None:
    """Trials of the same space today have other ids, and get those that they are recorded under."""
    planned = resolve_trials(load_space(RECORDED / "small.yaml"))
    trials = Experiment(RECORDED / "sweep").trials()
    assert [trial.id for trial in trials] == IDS
    assert [trial_id(trial.config) for trial in trials] == [trial.id for trial in planned] != IDS
    assert [trial.id for trial in with_recorded_ids(planned, trials)] == IDS


def test_ids_hold_what_is_trained_and_not_how() -> None:
    config = {"env": {"name": "cartpole"}}
    plain = trial_id(parse_config(config))
    elsewhere = {"threads": 2, "deterministic": True, "solver_kernels": "fused", "checkpoint_interval": 3}
    assert trial_id(parse_config({**config, "execution": elsewhere})) == plain
    assert trial_id(parse_config({**config, "shac": {"gamma": 0.99}})) == plain, "its default"
    assert trial_id(parse_config({**config, "shac": {"gamma": 0.98}})) != plain
    assert trial_id(parse_config({**config, "shac": {"entropy": {}}})) != plain, "a section without a change"


def test_a_later_setting_leaves_ids_as_they_are() -> None:
    class Before(Section):
        rate: float = 1.0
        needed: int

    class After(Before):
        later: float = 0.5
        nested: Before = Before(needed=1)
        kinds: Before | None = None

    assert changed_settings(Before(needed=3)) == changed_settings(After(needed=3)) == {"needed": 3}
    assert changed_settings(After(needed=3, nested=Before(needed=1, rate=2.0))) == {
        "needed": 3,
        "nested": {"needed": 1, "rate": 2.0},
    }


def test_moved_settings_are_read_where_they_were() -> None:
    old = {
        "trial": {"epochs": 3, "gpus": 2, "loggers": []},
        "physics": {"nconmax": 5},
        "shac": {"capture": "off", "critic_kernels": "auto", "copies": None},
    }
    assert current_settings(old) == {
        "trial": {"epochs": 3},
        "physics": {},
        "shac": {},
        "execution": {"gpus": 2, "loggers": [], "nconmax": 5, "capture": "off"},
    }
    assert current_settings(current_settings(old)) == current_settings(old)
    assert current_values({"trial.gpus": 2, "shac.critic_products": "tf32", "trial.seed": 1}) == {
        "execution.gpus": 2,
        "trial.seed": 1,
    }
    assert current_values({"shac.horizon": {"start": 4, "target": 2.0}})["shac.horizon"]["kind"] == "adaptive"
    assert current_settings({"shac": {"horizon": {"start": 4, "end": 8, "epochs": 2}}})["shac"]["horizon"]["kind"] == (
        "schedule"
    )
    assert current_values({"shac.horizon": {"longest": 9}}) == {"shac.horizon": {"longest": 9}}, "of any kind"
    with pytest.raises(ConfigError, match=r"shac\.copies: \{'count': 2\} has been removed"):
        current_settings({"shac": {"copies": {"count": 2}}})


REMOVED: list[tuple[dict[str, Any], dict[str, Any], dict[str, Any], str]] = [
    (
        {"shac": {"entropy": {"rate": 0.005, "target": 1.0}, "betas": [0.7, 0.95]}},
        {"shac": {"entropy": {"target": 1.0}}},
        {"shac": {"entropy": {"rate": 0.1}}},
        "shac.entropy.rate: 0.1",
    ),
    (
        {"shac": {"horizon": {"start": 4, "target": 2.0, "rate": 0.1}}},
        {"shac": {"horizon": {"kind": "adaptive", "start": 4, "target": 2.0}}},
        {"shac": {"horizon": {"start": 4, "target": 2.0, "rate": 0.5}}},
        "shac.horizon.rate: 0.5",
    ),
    (
        {"trial": {"seeds": {"noise": None, "policy": None}}, "actor": {"stochastic": True}},
        {"trial": {}, "actor": {}},
        {"trial": {"seeds": {"noise": 1}}},
        r"trial.seeds: \{'noise': 1\}",
    ),
    (
        {"env": {"name": "hopper", "reward": {"full_height": -0.3, "drop": 200.0}}},
        {"env": {"name": "hopper", "reward": {}}},
        {"env": {"name": "humanoid", "reward": {"full_height": -0.3}}},
        "env.reward.full_height: -0.3",
    ),
    (
        {"env": {"name": "own:Robot", "min_height": 0.7}},
        {"env": {"name": "own:Robot", "min_height": 0.7}},
        {"env": {"name": "myoleg26", "min_height": 0.7}},
        "env.min_height: 0.7",
    ),
]


@pytest.mark.parametrize(("harmless", "current", "gone", "message"), REMOVED, ids=[case[3] for case in REMOVED])
def test_removed_settings_are_read_where_they_changed_nothing(
    harmless: dict[str, Any], current: dict[str, Any], gone: dict[str, Any], message: str
) -> None:
    assert current_settings(harmless) == current
    assert current_settings(current) == current
    with pytest.raises(ConfigError, match=rf"{message} has been removed; leave it out, or use version 0.2"):
        current_settings(gone)


def test_removed_settings_within_a_value_of_a_space() -> None:
    values = {"shac.entropy": {"coefficient": 0.1, "rate": 0.005}, "shac.horizon": {"grid": [4, 8]}}
    assert current_values(values) == {"shac.entropy": {"coefficient": 0.1}, "shac.horizon": {"grid": [4, 8]}}
    with pytest.raises(ConfigError, match=r"trial\.seeds: unknown key; it has been removed"):
        parse_config({"env": {"name": "ant"}, "trial": {"seeds": {"noise": 1}}})
    assert current_space({"smoke": {"max_trials": 8}, "samples": 2}) == {"samples": 2}
    with pytest.raises(ConfigError, match=r"smoke: .* has been removed"):
        current_space({"smoke": {"max_trials": 4}})


def test_files_may_keep_the_old_spelling(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("env: {name: ant}\ntrial: {deterministic: true}\n")
    (tmp_path / "child.yaml").write_text("extends: base.yaml\nphysics: {njmax: 90}\n")
    execution = load_config(tmp_path / "child.yaml").execution
    assert (execution.deterministic, execution.njmax) == (True, 90)
    space = {"question": "?", "base": "child.yaml", "overrides": {"trial.checkpoint_interval": 7}}
    (tmp_path / "small.yaml").write_text(dump_yaml(space))
    (trial,) = resolve_trials(load_space(tmp_path / "small.yaml"))
    assert trial.config.execution.checkpoint_interval == 7


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("trial.gpus=2", "trial.gpus: unknown key; write execution.gpus"),
        ("physics.solver_kernels=fused", "physics.solver_kernels: unknown key; write execution.solver_kernels"),
        (
            "shac.copies={count: 2}",
            "shac.copies: unknown key; it has been removed; leave it out",
        ),
    ],
)
def test_what_is_typed_is_told_the_new_spelling(setting: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(train.main, ["--config", "ant", "--set", setting]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.long
def test_status_and_report_read_it(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(status.main, ["sweep", "--storage", str(recorded)]) == 0
    shown = capsys.readouterr().out
    assert "cart_action_penalty=0.02" in shown
    assert "cannot be read" not in shown
    assert run(report.main, ["sweep", "--storage", str(recorded)]) == 0
    page = (recorded / "sweep" / "report" / "index.html").read_text()
    assert "cannot be read" not in page
    assert "left out" not in page
    assert "cart_action_penalty" in page


@pytest.mark.long
def test_evaluate_and_visualize_read_policies(recorded: Path) -> None:
    folder = recorded / "sweep" / "trials" / IDS[1]
    rows = {row["epoch"]: row for row in read_metrics(folder / "metrics.jsonl")}
    best = load_policy(folder / "checkpoints" / "best.pt")
    assert best.config == parse_recorded(read_yaml(folder / "config.yaml"), "config.yaml")
    assert run(evaluate.main, [str(folder), "--device", "cpu"]) == 0
    scored = json.loads((folder / "eval.json").read_text())
    assert f"{rows[best.epoch]['eval/score']:.2f}"[:6] in json.dumps(scored), "under the same reference reward"
    assert run(visualize.main, [str(folder), "--no-render", "--device", "cpu"]) == 0


@pytest.mark.long
def test_an_experiment_goes_on(recorded: Path, plans: list[driver.Plan], capsys: pytest.CaptureFixture[str]) -> None:
    """The trials keep their ids and folders, and the one that was killed goes on from its checkpoint."""
    command = ["--space", str(recorded / "small.yaml"), "--storage", str(recorded), "--name", "sweep", "--cpu"]
    assert run(tune.main, [*command, "--resume"]) == RESUMABLE
    (plan,) = plans
    assert [trial.id for trial in plan.trials] == IDS
    trial = plan.trials[0]
    folder = plan.experiment.trial_folder(trial.id)
    ending = run_trial(trial, folder, "cpu", StopSpec(), Trainer, Hooks())
    assert ending is not None
    assert ending.outcome is Outcome.FINISHED
    assert [row["epoch"] for row in read_metrics(folder / "metrics.jsonl")] == [*range(7)]
    assert run(tune.main, [*command, "--resume", "--set", "env.reward.pole_velocity_penalty=0.3"]) == 2
    assert "env.reward.pole_velocity_penalty 0.2 → 0.3" in capsys.readouterr().err


def test_shipped_policies_are_read(root: Path) -> None:
    """Version 0.2 wrote them."""
    for path in sorted((root / "policies").glob("*.pt")):
        config: Any = load_policy(path).config
        assert config.execution.gpus == 1
        assert parse_recorded(yaml.safe_load(path.with_suffix(".yaml").read_text())["config"], path.name) == config
