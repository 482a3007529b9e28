"""A reward term from outside the package, for the ant of the package, whose weight is swept: `own_ant` is in no line
of it."""

import json
import pickle
import re
from pathlib import Path

import pytest
import torch
from own_ant import MyAnt

from msk_ray import train
from msk_ray.cli import run
from msk_ray.config import load_config
from msk_ray.envs import make_env
from msk_ray.envs.ant.env import Ant
from msk_ray.sweep.space import load_space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune import __main__ as tune


@pytest.fixture
def space(root: Path, tmp_path: Path) -> Path:
    """The search space that the page of environments shows, in a folder of its own."""
    page = (root / "docs" / "runner" / "environments.md").read_text()
    (shown,) = re.findall(r"`spin.yaml`:\n\n```yaml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "spin.yaml").write_text(shown)
    return tmp_path / "spin.yaml"


def test_it_has_its_default_weight_and_the_others_stay_what_they_are(root: Path) -> None:
    sets = ["env.nworld=2", "env.name=own_ant:MyAnt"]
    config = load_config(root / "configs" / "ant.yaml", sets)
    env = make_env(config.env, config.physics, 2, "cpu", 0)
    plain = make_env(load_config(root / "configs" / "ant.yaml", sets[:1]).env, config.physics, 2, "cpu", 0)
    assert isinstance(env, MyAnt)
    assert env.reward_names == (*plain.reward_names, "spin")
    state = env.state.physics
    turning = state._replace(qvel=torch.where(torch.arange(14) == 5, 3.0, 0.0).expand(2, 14))
    action = torch.zeros(2, 8)
    obs = env.observe(turning, action)
    terms = env.reward_terms(turning, action, obs)
    assert terms[:, -1].tolist() == pytest.approx([-0.1 * 3.0**2] * 2)
    assert torch.equal(terms[:, :-1], plain.reward_terms(turning, action, obs))
    assert "spin" not in Ant.Settings(name="ant").reward.model_dump()
    other = load_config(root / "configs" / "ant.yaml", [*sets, "env.reward.spin=0.0", "env.reward.up=0.3"])
    reference = MyAnt.reference_settings(other.env)
    assert (reference.reward.spin, reference.reward.up) == (-0.1, 0.1)


def test_its_weight_is_swept(space: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tune.main, ["--space", str(space), "--dry-run"]) == 0
    assert "spin=-0.5" in capsys.readouterr().out
    trials = resolve_trials(load_space(space))
    weights = [trial.config.env.reward.spin for trial in trials]
    assert sorted(set(weights)) == [-0.5, -0.1, 0.0]
    assert len({trial.id for trial in trials}) == len(trials)
    for trial in trials:  # as they reach the processes of a sweep
        assert pickle.loads(pickle.dumps(trial.config)) == trial.config
    assert run(tune.main, ["--space", str(space), "--dry-run", "--set", "env.reward.spinn=1"]) == 2
    assert "did you mean 'spin'?" in capsys.readouterr().err


@pytest.mark.long
def test_it_trains_and_is_logged(root: Path, tmp_path: Path) -> None:
    small = ("nworld=2", "name=own_ant:MyAnt", "reward.spin=-0.5")
    short = ("shac.horizon=2", "trial.epochs=1", "actor.hidden=[8]", "critic.hidden=[8]")
    short += ("evaluation.nworld=2", "evaluation.steps=3", "evaluation.interval=1")
    sets = [part for setting in (*(f"env.{s}" for s in small), *short) for part in ("--set", setting)]
    config = str(root / "configs" / "ant.yaml")
    assert run(train.main, ["--config", config, "--device", "cpu", "--logdir", str(tmp_path / "run"), *sets]) == 0
    row = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[-1])
    assert row["eval/term/spin"] < 0.0
