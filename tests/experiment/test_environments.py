"""Scores of different environments are never compared: tables, status, terminal and early stopping keep them apart."""

import json
import math
from pathlib import Path

import pytest
from bodies import make_bodies

from msk_ray.errors import CheckpointError, ConfigError
from msk_ray.evaluate.targets import Kind, Target, checkpoint_of
from msk_ray.experiment.attempts import FIRST
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.trial import by_environment
from msk_ray.status import main as status
from msk_ray.sweep.budget import extreme_configs
from msk_ray.sweep.rules.asha import Asha
from msk_ray.sweep.rules.scheduler import PerEnvironment
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune.console import Console
from msk_ray.tune.finish import finish


@pytest.fixture(scope="module")
def bodies(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """Not to be changed, but for the results at its end."""
    return make_bodies(tmp_path_factory.mktemp("bodies"))


def best_ids(bodies: Experiment) -> dict[str, str]:
    return {t.environment: t.id for t in bodies.trials() if t.seed == 1 and t.changed["variant"] == "fast"}


def test_the_results_name_the_best_trial_of_each(bodies: Experiment, capsys: pytest.CaptureFixture[str]) -> None:
    finish(bodies)
    shown = capsys.readouterr().out
    for name, score in (("hopper", "12"), ("cheetah", "1200")):
        assert f"best trial   {best_ids(bodies)[name]}: {name}, fast seed=1 in {name}, score {score}\n" in shown
    facts = json.loads((bodies.path / "summary.json").read_text())
    assert {name: best["score"] for name, best in facts["best"].items()} == {"hopper": 12.0, "cheetah": 1200.0}
    table = (bodies.path / "table.md").read_text()
    assert table.index("    hopper\n") < table.index("  hopper, fast  ") < table.index("    cheetah\n")


def test_status_names_the_best_trial_of_each(bodies: Experiment, capsys: pytest.CaptureFixture[str]) -> None:
    assert status([str(bodies.path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    ids = best_ids(bodies)
    assert f"best cheetah 1200 ({ids['cheetah']}), hopper 12 ({ids['hopper']})" in lines[0]
    assert status(["--storage", str(bodies.path.parent)]) == 0
    listed = capsys.readouterr().out
    assert "cheetah 1200" in listed
    assert "hopper 12" in listed


def test_the_terminal_names_the_best_trial_of_each(bodies: Experiment, capsys: pytest.CaptureFixture[str]) -> None:
    trials = bodies.trials()
    console = Console(trials, 2)
    hopper = next(trial for trial in trials if trial.environment == "hopper")
    cheetah = next(trial for trial in trials if trial.environment == "cheetah")
    console.started(cheetah, FIRST)
    console.evaluated(cheetah, 2, 200.0, 200.0)
    console.started(hopper, FIRST)
    console.evaluated(hopper, 2, 2.0, 2.0)
    assert f"{hopper.id} best so far in hopper: score 2 at epoch 2/4" in capsys.readouterr().out
    assert f"best hopper 2 ({hopper.id}), cheetah 200 ({cheetah.id})" in console.status()


def test_an_experiment_over_several_has_no_best_policy(bodies: Experiment) -> None:
    with pytest.raises(CheckpointError, match="a best trial for each environment") as refused:
        checkpoint_of(Target(Kind.EXPERIMENT, bodies.path))
    assert all(identity in str(refused.value) for identity in best_ids(bodies).values())


def test_early_stopping_judges_each_by_itself(bodies: Experiment) -> None:
    rule = Asha(kind="asha", grace=0.5, reduction=2.0, min_trials=2)
    trials = bodies.trials()
    groups = by_environment(trials, lambda trial: trial.environment)
    pruner = PerEnvironment({name: rule.pruner(400.0) for name in groups}, {t.id: t.environment for t in trials})
    ended = []
    for trial in sorted((t for t in trials if t.seed == 0), key=lambda trial: "fast" not in trial.variant):
        score = {"hopper": 1.0, "cheetah": 100.0}[trial.environment] * (2.0 if "fast" in trial.variant else 1.0)
        if pruner.report(trial.id, 200.0, score) is not None:
            ended.append(trial.variant)
    # The faster hopper is the best of its kind, though far below every cheetah.
    assert ended == ["hopper, SHAC", "cheetah, SHAC"]
    pruner.forget(trials[0].id)
    assert pruner.report("unknown", 200.0, math.inf) is None


def test_what_cannot_keep_them_apart_is_refused(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("env: {name: cartpole}\n")
    rate = {"shac.actor_lr": {"loguniform": [1e-4, 1e-2]}}
    both = [{"label": name, "value": {"name": name}} for name in ("cartpole", "hopper")]

    def space(kind: str, operator: str = "grid", **more: object):  # type: ignore[no-untyped-def]
        data = {"question": "?", "base": "base.yaml", "parameters": rate | {"env": {operator: both}}, "samples": 2}
        return parse_space(data | {"scheduler": {"kind": kind}} | more, tmp_path / "s.yaml")

    with pytest.raises(ConfigError, match=r"pbt lets trials .* \(cartpole, hopper\) cannot be compared; write a space"):
        resolve_trials(space("pbt"))
    with pytest.raises(ConfigError, match=r"optuna learns .* \(cartpole, hopper\) cannot be compared; write a space"):
        extreme_configs(space("none", "choice", search="optuna"))
    assert len(resolve_trials(space("asha"))) == 4


def test_the_baseline_of_an_ablation_has_a_name_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("env: {name: cartpole}\n")
    data = {"question": "?", "base": "base.yaml", "ablate": {"label": "SHAC", "variants": {"SHAC": {}}}}
    with pytest.raises(ConfigError, match=r"s\.yaml: the baseline and a variant are both called SHAC"):
        parse_space(data, tmp_path / "s.yaml")
