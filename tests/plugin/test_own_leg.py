"""A reward term from outside the package, for legs of the package: `own_leg` is in no line of it."""

import json
from pathlib import Path

import pytest
import torch
from own_leg import SmoothLegs

from msk_ray.cli import run
from msk_ray.config import load_config
from msk_ray.envs import make_env
from msk_ray.train import main

SMALL = ("nworld=2", "name=own_leg:SmoothLegs")


def test_it_is_in_the_reward_with_its_weight(root: Path) -> None:
    config = load_config(root / "configs" / "myoleg26.yaml", [f"env.{setting}" for setting in SMALL])
    env = make_env(config.env, config.physics, 2, "cpu", 0)
    assert isinstance(env, SmoothLegs)
    state = env.state.physics
    falling = state._replace(qvel=torch.where(torch.arange(state.qvel.shape[1]) == 1, 2.0, 0.0).expand_as(state.qvel))
    still = state._replace(qvel=torch.zeros_like(state.qvel))
    action = torch.zeros(2, env.action_size)
    terms = [env.reward_terms(s, action, env.observation()) for s in (falling, still)]
    assert terms[0].shape == (2, len(env.reward_names))
    assert terms[0][:, -1].tolist() == pytest.approx([-0.5 * 2.0**2] * 2)
    assert terms[1][:, -1].tolist() == [0.0, 0.0]


@pytest.mark.long
def test_it_trains_and_is_scored_term_by_term(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ("shac.horizon=2", "trial.epochs=1", "actor.hidden=[8]", "critic.hidden=[8]", "env.reward.bounce=2")
    small += ("evaluation.nworld=2", "evaluation.steps=3", "evaluation.interval=1")
    sets = [part for setting in (*(f"env.{s}" for s in SMALL), *small) for part in ("--set", setting)]
    config = str(root / "configs" / "myoleg26.yaml")
    assert run(main, ["--config", config, "--device", "cpu", "--logdir", str(tmp_path / "run"), *sets]) == 0
    row = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[-1])
    assert row["eval/term/bounce"] < 0.0
    first = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[0])
    assert f"(untrained {first['eval/score']:.1f})" in capsys.readouterr().out
