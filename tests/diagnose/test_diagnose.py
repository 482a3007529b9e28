"""Gradient quality along trajectories: right where it must be, and wrong input named."""

import json

import pytest

from msk_ray.config import dump_yaml, parse_config
from msk_ray.diagnose.__main__ import main
from msk_ray.errors import ConfigError
from msk_ray.training import Trainer


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory):
    """A CartPole trial of one epoch."""
    folder = tmp_path_factory.mktemp("trial")
    config = parse_config(
        {
            "env": {"name": "cartpole", "nworld": 4},
            "shac": {"horizon": 4, "critic_batches": 1, "critic_iterations": 1},
            "actor": {"hidden": [8]},
            "critic": {"hidden": [8]},
            "evaluation": {"nworld": 2, "steps": 4},
            "trial": {"epochs": 1},
        }
    )
    trainer = Trainer(config, folder, "cpu")
    trainer.run_epoch()
    trainer.close()
    return folder


@pytest.mark.long
def test_a_trained_policys_gradients_match_float64_from_every_state(cartpole, tmp_path, capsys):
    arguments = ["--horizons", "1", "8", "--worlds", "2", "--directions", "6", "--output", str(tmp_path)]
    assert main([str(cartpole / "checkpoints" / "best.pt"), *arguments]) == 0
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert {row["state"] for row in rows} == {"reset", "standing", "gait"}
    assert len(rows) == 3 * 2 * 2
    for row in rows:
        assert row["cosine"] > 0.999
        assert row["norm_ratio"] == pytest.approx(1.0, abs=5e-3)
        assert row["cotangent"] > 0.0
    assert (tmp_path / "quality.png").stat().st_size > 10_000
    assert (tmp_path / "table.md").read_text().count("\n") == 2 + 6
    assert "quality.png" in capsys.readouterr().out


@pytest.mark.long
def test_the_ant_under_two_physics(tmp_path):
    (tmp_path / "ant.yaml").write_text(dump_yaml({"env": {"name": "ant"}, "actor": {"hidden": [8]}}))
    arguments = ["--variants", "matched", "published", "--states", "standing", "--horizons", "2"]
    assert main([str(tmp_path / "ant.yaml"), *arguments, "--worlds", "1", "--output", str(tmp_path / "out")]) == 0
    matched, published = json.loads((tmp_path / "out" / "rows.json").read_text())
    assert matched["cosine"] > 0.999
    # The hard contacts and the pyramid's edges send far more back.
    assert published["cotangent"] > 3 * matched["cotangent"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--variants", "matchd"], "no physics named 'matchd'; write matched"),
        (["--states", "gait"], "needs a trained policy"),
    ],
)
def test_wrong_input_is_named(tmp_path, arguments, message):
    (tmp_path / "ant.yaml").write_text(dump_yaml({"env": {"name": "ant"}}))
    with pytest.raises(ConfigError) as caught:
        main([str(tmp_path / "ant.yaml"), *arguments, "--output", str(tmp_path / "out")])
    assert message in str(caught.value)
