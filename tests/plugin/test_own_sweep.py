"""Rules, searches and operators from outside the package, by import path: `own_sweep` is in no line of it."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from own_sweep import Enough, Floor, LowToHigh, PowersOfTwo
from ray.tune.search import Searcher

from msk_ray.config import read_yaml
from msk_ray.errors import ConfigError
from msk_ray.experiment.metrics import Evaluation
from msk_ray.experiment.outcomes import Ending, Outcome
from msk_ray.sweep import opening
from msk_ray.sweep.rules.stop_rule import History
from msk_ray.sweep.smoke import without_early_stopping
from msk_ray.sweep.space import recorded_space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune.queue import Suggestions

RATE = {"shac.actor_lr": {"uniform": [0.001, 0.002]}}


def after(evaluations: int) -> History:
    seen = [Evaluation(epoch, 100 * epoch, 1.0, 1.0) for epoch in range(1, evaluations + 1)]
    return History({"epoch": evaluations, "env_steps": 100, "seconds": 1.0, "eval/score": 1.0}, seen, 20, 1.0)


def test_a_stop_rule(make_space: Any, tmp_path: Path) -> None:
    space = make_space(stop={"target": 5, "rules": {"own_sweep:Enough": {"evaluations": 3}}})
    assert list(space.file.stop.rules.values()) == [Enough(evaluations=3)]
    assert space.file.stop.ending(after(2)) is None
    assert space.file.stop.ending(after(3)) == Ending(Outcome.STOPPED_RULE, "3 evaluations are enough")
    assert without_early_stopping(space).file.stop.ending(after(3)) is None
    made = opening.create(tmp_path / "e", space, [], {})
    (tmp_path / "e" / "base.yaml").write_text((tmp_path / "base.yaml").read_text())
    assert read_yaml(made.path / "space.yaml")["stop"] == {
        "target": 5.0,
        "rules": {"own_sweep:Enough": {"evaluations": 3}},
    }
    assert recorded_space(made.path / "space.yaml").file.stop == space.file.stop


def test_a_rule_that_compares_trials(make_space: Any) -> None:
    space = make_space(scheduler={"kind": "own_sweep:Floor", "floor": 2.0, "time_attr": "epoch"})
    assert space.file.scheduler == Floor(kind="own_sweep:Floor", floor=2.0, time_attr="epoch")
    pruner = space.file.scheduler.pruner(20)
    assert pruner.report("a", 9, 1.0) is None
    assert pruner.report("a", 10, 1.0) == Ending(Outcome.STOPPED_RULE, "1 is below 2")
    assert without_early_stopping(space).file.scheduler.kind == "none"


def test_an_operator(make_space: Any) -> None:
    space = make_space(parameters={"shac.horizon": {"own_sweep:PowersOfTwo": [2, 4]}}, samples=2, sample_seed=1)
    assert space.sampled == {"shac.horizon": PowersOfTwo(2, 4)}
    horizons = [trial.config.shac.horizon for trial in resolve_trials(space)]
    assert set(horizons) <= {4, 8, 16}
    assert [trial.changed["shac.horizon"] for trial in resolve_trials(space)] == list(map(str, horizons))


def test_a_search_is_asked_and_told(make_space: Any, tmp_path: Path) -> None:
    space = make_space(search="own_sweep:LowToHigh", parameters=RATE, samples=3)
    search = LowToHigh(space.sampled, 0)
    experiment = opening.create(tmp_path / "e", space, [], {})
    begun = {"shac.actor_lr": 0.0015}
    suggestions = Suggestions(experiment, lambda config: str(config["params"]["shac.actor_lr"]), search, [begun], 3)
    assert suggestions.suggest("a") == {"params": begun}, "what was begun before comes first"
    suggested = suggestions.suggest("b")
    assert suggested["params"]["shac.actor_lr"] == pytest.approx(0.0011)
    folder = experiment.trial_folder(str(suggested["params"]["shac.actor_lr"]))
    folder.mkdir()
    scores = [9.0, 1.0, 3.0, 2.0]  # the first is of the untrained policy
    rows = [{"epoch": n, "env_steps": n, "seconds": n, "eval/score": score} for n, score in enumerate(scores)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    suggestions.on_trial_complete("b", {})
    suggestions.on_trial_complete("a", error=True)
    assert search.told == [(suggested["params"], 3.0), (begun, None)]
    suggestions.suggest("c")
    assert suggestions.suggest("d") == Searcher.FINISHED


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stop": {"rules": {"own_sweep:Enough": {"evaluation": 3}}}}, "did you mean 'evaluations'"),
        ({"stop": {"rules": {"own_sweep:Enuogh": {}}}}, "did you mean 'Enough'"),
        ({"stop": {"rules": {"own_sweep:LowToHigh": {}}}}, "not a subclass of msk_ray.sweep.rules.stop_rule.StopRule"),
        ({"stop": {"rules": {"msk_ray.sweep.rules.stop_rule:StopRule": {}}}}, "StopRule lacks why"),
        ({"search": "msk_ray.sweep.search:Search"}, "search: msk_ray.sweep.search:Search lacks "),
        ({"scheduler": {"kind": "own_sweep:Floor", "flor": 1}}, "did you mean 'floor'"),
        ({"scheduler": {"kind": "ahsa"}}, "scheduler.kind: unknown name 'ahsa'; did you mean 'asha'"),
        ({"scheduler": {"kind": "asha", "quantile": 0.2}}, "scheduler.quantile: unknown key; known keys: kind, "),
        ({"search": "optnua"}, "search: unknown name 'optnua'; did you mean 'optuna'"),
        ({"search": "own_sweep:LowToHigh"}, "parameters.shac.actor_lr.grid: search: LowToHigh cannot enumerate"),
        ({"parameters": {"shac.horizon": {"own_sweep:Nothing": [1]}}}, "has no 'Nothing'"),
        ({"search": "optuna", "parameters": {"shac.horizon": {"own_sweep:PowersOfTwo": [2, 4]}}}, None),
    ],
)
def test_faults_are_one_line(make_space: Any, changes: dict[str, Any], message: str | None) -> None:
    if message is None:
        pytest.importorskip("optuna")
        space = make_space(**changes)
        from msk_ray.sweep.search import search_class

        with pytest.raises(ConfigError, match="optuna searches lists and ranges, not PowersOfTwo"):
            search_class("optuna")(space.sampled, 0)
        return
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        make_space(**changes)
    assert "\n" not in str(caught.value)
