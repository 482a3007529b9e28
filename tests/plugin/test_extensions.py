"""An algorithm and a logger of a few lines, from files that the package does not know, go through the commands."""

import csv
import json
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from msk_ray import train
from msk_ray.cli import run
from msk_ray.config import dump_yaml, parse_config, read_yaml
from msk_ray.diagnose import __main__ as diagnose
from msk_ray.errors import ConfigError
from msk_ray.evaluate import __main__ as evaluate
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import read_metrics
from msk_ray.metrics import SCORE
from msk_ray.sweep.smoke import shorten
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.training import Trainer, load_policy
from msk_ray.training.checkpoint import epoch_checkpoints
from msk_ray.tune import __main__ as tune
from msk_ray.tune import driver
from msk_ray.tune.devices import Placement

HERE = Path(__file__).resolve().parent
SETTINGS = {
    "env": {"name": "cartpole", "nworld": 8, "episode_length": 40},
    "algorithm": {"name": "random_search:RandomSearch", "settings": {"noise": 0.2, "steps": 4}},
    "evaluation": {"interval": 1, "nworld": 4, "steps": 20},
    "trial": {"epochs": 4},
    "execution": {"checkpoint_interval": 2, "loggers": ["tensorboard", "table_logger:Table"]},
}


@pytest.fixture(autouse=True)
def outside(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """This folder is where modules are found, as a user's working folder is."""
    monkeypatch.syspath_prepend(HERE)
    yield
    for name in ("random_search", "table_logger"):
        sys.modules.pop(name, None)


def figures(folder: Path) -> list[dict[str, float]]:
    timed = ("seconds", "env_steps_per_s", "time/evaluation_s")
    return [{k: v for k, v in row.items() if k not in timed} for row in read_metrics(folder / "metrics.jsonl")]


def test_train_resume_and_evaluate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "search.yaml").write_text(dump_yaml(SETTINGS))
    command = ["--config", str(tmp_path / "search.yaml"), "--device", "cpu", "--logdir"]
    assert run(train.main, [*command, str(tmp_path / "whole")]) == 0
    first = Trainer(parse_config(SETTINGS), tmp_path / "cut", "cpu")
    assert first.env.sim.backward is None
    for _ in range(3):
        first.run_epoch()
    first.close()
    torch.rand(3)  # another process has drawn other numbers
    assert run(train.main, [*command, str(tmp_path / "cut"), "--resume"]) == 0
    assert figures(tmp_path / "cut") == figures(tmp_path / "whole")
    assert [row["env_steps"] for row in figures(tmp_path / "whole")] == [64 * epoch for epoch in range(5)]
    scores = [(row["epoch"], row[SCORE]) for row in figures(tmp_path / "whole")]
    with (tmp_path / "whole" / "scores.csv").open() as file:
        assert [(int(epoch), float(score)) for epoch, score in csv.reader(file)] == scores
    assert read_yaml(tmp_path / "whole" / "config.yaml")["algorithm"]["settings"] == {"noise": 0.2, "steps": 4}
    assert run(evaluate.main, [str(tmp_path / "whole"), "--device", "cpu"]) == 0
    saved = load_policy(tmp_path / "whole" / "checkpoints" / "best.pt")
    best = dict(scores)[saved.epoch]
    assert f"{best:.4f}"[:6] in json.dumps(json.loads((tmp_path / "whole" / "eval.json").read_text()))
    newest = epoch_checkpoints(tmp_path / "whole" / "checkpoints")[0]
    arguments = ["--horizons", "1", "--worlds", "1", "--directions", "3", "--states", "reset"]
    assert run(diagnose.main, [str(newest), *arguments, "--output", str(tmp_path / "out")]) == 0
    (row,) = json.loads((tmp_path / "out" / "rows.json").read_text())
    assert row["cosine"] > 0.99
    capsys.readouterr()


def test_its_settings_are_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "search.yaml").write_text(dump_yaml(SETTINGS))
    command = ["--config", str(tmp_path / "search.yaml"), "--logdir", str(tmp_path / "run"), "--device", "cpu", "--set"]
    for said, message in (
        ("algorithm.settings.nois=1", "algorithm.settings.nois: unknown key; did you mean 'noise'?"),
        ("algorithm.name=random_search:RandomSerch", "did you mean 'RandomSearch'?"),
        ("shac.gamma=0.9", "nothing reads it while algorithm.name is random_search:RandomSearch"),
        ("execution.loggers=[table_logger:Tables]", "did you mean 'Table'?"),
    ):
        assert run(train.main, [*command, said]) == 2
        assert message in capsys.readouterr().err


def test_a_space_varies_its_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "search.yaml").write_text(dump_yaml(SETTINGS))
    grid = {"algorithm.settings.noise": {"grid": [0.1, 0.3]}}
    (tmp_path / "noise.yaml").write_text(dump_yaml({"question": "?", "base": "search.yaml", "parameters": grid}))
    assert run(tune.main, ["--space", str(tmp_path / "noise.yaml"), "--dry-run"]) == 0
    assert "noise=0.3" in capsys.readouterr().out
    assert "trial.epochs" in shorten(parse_config(SETTINGS))


def test_a_space_of_an_algorithm_that_does_not_say_its_env_steps(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(dump_yaml(SETTINGS))
    grid = {"algorithm.settings.noise": {"grid": [0.1, 0.2]}}
    described = {"question": "How much noise?", "base": "base.yaml", "parameters": grid}
    assert budget(described, tmp_path) == math.inf
    compared = {"kind": "asha", "time_attr": "epoch"}
    assert budget({**described, "scheduler": compared}, tmp_path) == 4
    with pytest.raises(ConfigError, match=r"env_steps, or scheduler\.time_attr: epoch"):
        budget({**described, "scheduler": {"kind": "asha"}}, tmp_path)


def budget(described: dict[str, object], folder: Path) -> float:
    """The longest trial of a space with this file."""
    space = parse_space(described, folder / "noise.yaml")
    experiment = Experiment(folder / "runs")
    return driver._budget(driver.Plan(experiment, space, resolve_trials(space), Placement(0.0, 1), None))


@pytest.mark.parametrize(
    ("page", "file"), [("algorithms", "random_search"), ("environments", "own_ant"), ("loggers", "table_logger")]
)
def test_the_pages_show_these_files(page: str, file: str, root: Path) -> None:
    shown = re.findall(r"```python\n(.*?)```", (root / "docs" / "runner" / f"{page}.md").read_text(), re.DOTALL)
    assert (HERE / f"{file}.py").read_text() in shown
