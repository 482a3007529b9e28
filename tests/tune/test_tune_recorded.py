"""What the first version wrote is read by this one: `tests/fixtures/recorded`, made by `tests/fixtures/record.py`."""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from msk_ray import status, train
from msk_ray.cli import run
from msk_ray.config import (
    current_key,
    dump_yaml,
    load_config,
    overlay,
    parse_config,
    parse_recorded,
    read_yaml,
)
from msk_ray.config.recorded import current_settings
from msk_ray.errors import ConfigError
from msk_ray.evaluate import __main__ as evaluate
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import read_metrics
from msk_ray.experiment.outcomes import Outcome
from msk_ray.experiment.trial import trial_id
from msk_ray.report import __main__ as report
from msk_ray.signals import RESUMABLE
from msk_ray.sweep.rules.stopping import StopSpec
from msk_ray.sweep.search_trials import recover
from msk_ray.sweep.space import load_space
from msk_ray.sweep.trials import resolve_trials, with_recorded_ids
from msk_ray.training import Trainer
from msk_ray.training.policy import load_policy
from msk_ray.tune import __main__ as tune
from msk_ray.tune import driver
from msk_ray.tune.trial_run import Hooks, run_trial
from msk_ray.visualize import __main__ as visualize

pytestmark = pytest.mark.long

RECORDED = Path(__file__).parents[1] / "fixtures" / "recorded"
CONFIGS = sorted((RECORDED / "configs").glob("*.yaml"))


_KERNELS = ["physics.solver_kernels=mujoco_warp", "shac.critic_kernels=torch"]
SINCE = {
    "ant": [*_KERNELS, "physics.backward=tape_per_substep"],
    "ant_hard_friction": [*_KERNELS, "physics.backward=tape_per_substep"],
    "ant_fd": _KERNELS,
    "myoleg26": _KERNELS,
}
"""What takes back the settings that a shipped config has been given since: they make it faster."""


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """A copy to work on."""
    return Path(shutil.copytree(RECORDED, tmp_path / "recorded"))


@pytest.mark.parametrize("path", [path for path in CONFIGS if path.stem != "unread"], ids=lambda path: path.stem)
def test_every_shipped_config_means_what_it_meant(path: Path, root: Path) -> None:
    (shipped,) = (root / "configs").rglob(path.name)
    assert parse_recorded(read_yaml(path), str(path)) == load_config(shipped, SINCE.get(path.stem, []))


def test_what_nothing_read_is_dropped_from_records_alone() -> None:
    path = RECORDED / "configs" / "unread.yaml"
    config = parse_recorded(read_yaml(path), str(path))
    assert (config.env.reward.sway, config.env.model) == (0.1, "legs.xml")
    assert (config.env.source, config.physics.friction, config.shac.state_grad_clip) == ("auto", None, None)
    with pytest.raises(ConfigError, match=r"physics\.friction: env myoleg does not read it; leave it out"):
        load_config(path)
    assert parse_recorded(config.as_dict(), "again") == config


@pytest.mark.parametrize("name", ["finished", "interrupted"])
def test_ids_are_those_of_the_first_version(name: str) -> None:
    """If this fails after a setting was added: name it, with its default, in `config.recorded._LATER`."""
    entries = json.loads((RECORDED / name / "manifest.json").read_text())["trials"]
    for entry in entries:
        text = json.dumps(entry["config"], sort_keys=True, separators=(",", ":"))
        assert hashlib.sha256(text.encode()).hexdigest()[:8] == entry["id"]
        assert trial_id(parse_recorded(entry["config"], "manifest")) == entry["id"]
    space = load_space(RECORDED / "small.yaml")
    assert [trial.id for trial in resolve_trials(space)] == [entry["id"] for entry in entries]
    assert list(space.parameters) == ["env.reward.cart_action_penalty"]


def test_trials_that_set_what_nothing_reads_keep_their_ids(root: Path, tmp_path: Path) -> None:
    """The first version's CartPole config set `physics.fd`, which its backward mode does not read."""
    old = read_yaml(RECORDED / "configs" / "cartpole.yaml")
    text = json.dumps(old, sort_keys=True, separators=(",", ":"))
    entry = {"index": 0, "id": hashlib.sha256(text.encode()).hexdigest()[:8], "changed": {}, "values": {}}
    folder = tmp_path / "old"
    folder.mkdir()
    manifest = {"format": 1, "trials": [{**entry, "config": old}]}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (tmp_path / "one.yaml").write_text(dump_yaml({"question": "?", "base": str(root / "configs" / "cartpole.yaml")}))
    planned = resolve_trials(load_space(tmp_path / "one.yaml"))
    assert planned[0].id != entry["id"]
    assert [trial.id for trial in with_recorded_ids(planned, Experiment(folder).trials())] == [entry["id"]]
    longer = parse_recorded(overlay(old, {"trial.epochs": 900}), "extended").as_dict()
    (folder / "manifest.json").write_text(json.dumps(manifest | {"trials": [{**entry, "config": longer}]}))
    assert [trial.id for trial in with_recorded_ids(planned, Experiment(folder).trials())] == [entry["id"]]


@pytest.mark.parametrize("name", ["finished", "interrupted", "searched"])
def test_status_and_report_read_it(
    name: str, recorded: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")  # a narrower terminal breaks what was changed over two lines
    assert run(status.main, [name, "--storage", str(recorded)]) == 0
    shown = capsys.readouterr().out
    assert "cart_action_penalty=0.02" in shown
    assert "cannot be read" not in shown
    assert run(report.main, [name, "--storage", str(recorded)]) == 0
    page = (recorded / name / "report" / "index.html").read_text()
    assert "cannot be read" not in page
    assert "left out" not in page
    assert "cart_action_penalty" in page


def test_a_search_goes_on_from_its_trials(recorded: Path) -> None:
    made = recover(Experiment(recorded / "searched"), load_space(recorded / "searched.yaml"))
    assert sorted(entry.params["env.reward.cart_action_penalty"] for entry in made) == [0.02, 0.05]


def test_evaluate_and_visualize_read_policies(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(evaluate.main, ["finished", "--storage", str(recorded), "--device", "cpu"]) == 0
    before = {row["epoch"]: row for row in read_metrics(RECORDED / "train_finished" / "metrics.jsonl")}
    best = load_policy(recorded / "train_finished" / "checkpoints" / "best.pt")
    assert best.config.env.reward.cart_position_penalty == 0.1
    capsys.readouterr()
    assert run(evaluate.main, [str(recorded / "train_finished"), "--device", "cpu"]) == 0
    scored = json.loads((recorded / "train_finished" / "eval.json").read_text())
    assert f"{before[best.epoch]['eval/score']:.2f}"[:6] in json.dumps(scored), "under the same reference reward"
    assert run(visualize.main, [str(recorded / "train_finished"), "--no-render", "--device", "cpu"]) == 0


@pytest.mark.parametrize("name", ["ant", "myoleg26"])
def test_policies_of_other_environments_are_read(name: str) -> None:
    policy = load_policy(RECORDED / name / "checkpoints" / "best.pt")
    assert policy.config == parse_recorded(read_yaml(RECORDED / name / "config.yaml"), name)
    expected: dict[str, Any] = {"ant": ("forward_vel", 3.0), "myoleg26": ("capture_scale", 0.2)}
    weight, value = expected[name]
    assert getattr(policy.config.env.reward, weight) == value


def test_an_experiment_goes_on(recorded: Path, plans: list[driver.Plan], capsys: pytest.CaptureFixture[str]) -> None:
    """The trials keep their ids and folders; the interrupted one ends as the same trial that was not interrupted."""
    command = ["--space", str(recorded / "small.yaml"), "--storage", str(recorded), "--name", "interrupted", "--cpu"]
    assert run(tune.main, [*command, "--resume"]) == RESUMABLE
    (plan,) = plans
    assert [trial.id for trial in plan.trials] == [path["id"] for path in _manifest(RECORDED / "interrupted")]
    assert plan.experiment.trials() == plan.trials
    trial = next(t for t in plan.trials if t.values == {"env.reward.cart_action_penalty": 0.01})
    folder = plan.experiment.trial_folder(trial.id)
    ending = run_trial(trial, folder, "cpu", StopSpec(), Trainer, Hooks())
    assert ending is not None
    assert ending.outcome is Outcome.FINISHED
    whole = read_metrics(RECORDED / "finished" / "trials" / trial.id / "metrics.jsonl")
    rows = read_metrics(folder / "metrics.jsonl")
    assert [row["epoch"] for row in rows] == [row["epoch"] for row in whole]
    assert rows[-1]["eval/score"] == pytest.approx(whole[-1]["eval/score"], rel=1e-4)
    assert run(tune.main, [*command, "--resume", "--set", "env.reward.pole_velocity_penalty=0.3"]) == 2
    assert "env.reward.pole_velocity_penalty 0.2 → 0.3" in capsys.readouterr().err


def _manifest(folder: Path) -> list[dict[str, Any]]:
    trials: list[dict[str, Any]] = json.loads((folder / "manifest.json").read_text())["trials"]
    return trials


def test_a_training_goes_on(recorded: Path) -> None:
    folder = recorded / "train_interrupted"
    command = ["--config", str(recorded / "base.yaml"), "--logdir", str(folder), "--device", "cpu", "--resume"]
    assert run(train.main, command) == 0
    rows, whole = (read_metrics(path / "metrics.jsonl") for path in (folder, RECORDED / "train_finished"))
    assert rows[-1]["eval/score"] == pytest.approx(whole[-1]["eval/score"], rel=1e-4)
    assert read_yaml(folder / "config.yaml")["env"]["reward"]["cart_position_penalty"] == 0.1


def test_files_may_keep_the_old_spelling(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("env: {name: ant, up: 0.5}\n")
    (tmp_path / "child.yaml").write_text("extends: base.yaml\nenv: {forward_vel: 2.0}\n")
    reward = load_config(tmp_path / "child.yaml").env.reward
    assert (reward.up, reward.forward_vel) == (0.5, 2.0)
    (tmp_path / "small.yaml").write_text(
        dump_yaml(
            {
                "question": "?",
                "base": "child.yaml",
                "overrides": {"env.height": 2.0, "env": {"heading": 0.5}},
                "ablate": {"baseline": {"env.up": 0.3}, "variants": {"fast": {"env.forward_vel": 5.0}}},
            }
        )
    )
    slow, fast = (trial.config.env.reward for trial in resolve_trials(load_space(tmp_path / "small.yaml")))
    assert (slow.height, slow.heading, slow.up, slow.forward_vel) == (2.0, 0.5, 0.3, 2.0)
    assert fast.forward_vel == 5.0


def test_what_is_typed_is_told_the_new_spelling(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = str(root / "configs" / "ant.yaml")
    assert run(train.main, ["--config", config, "--set", "env.forward_vel=3"]) == 2
    assert "env.forward_vel: unknown key; write env.reward.forward_vel" in capsys.readouterr().err
    assert run(tune.main, ["--space", "ant_lr", "--dry-run", "--set", "env.forward_vel=3"]) == 2
    assert "env.forward_vel: unknown key; write env.reward.forward_vel" in capsys.readouterr().err
    with pytest.raises(ConfigError, match=r"write env\.reward\.up"):
        parse_config({"env": {"name": "ant", "up": 1.0, "reward": {"height": 1.0}}})


def test_other_environments_keep_their_own_words() -> None:
    hopper = {"env": {"name": "hopper", "height": 1.0}}
    assert current_settings(hopper, "hopper") == hopper
    assert current_key("env.height", "hopper") == "env.height"
    assert current_key("env.height", "ant") == "env.reward.height"
    assert current_key("env.termination_height", "ant") == "env.termination_height"
