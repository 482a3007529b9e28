"""The examples of the documentation run, in tiny size."""

import re
import runpy
import sys
from pathlib import Path

import matplotlib
import pytest

import msk_ray
from msk_ray.sweep.space import load_space
from msk_ray.sweep.trials import resolve_trials

pytestmark = pytest.mark.long

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"


def run(monkeypatch, capsys, name: str, *arguments: str) -> str:
    """Run an example as its own program, in this process; returns what it printed."""
    matplotlib.use("Agg")
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    monkeypatch.syspath_prepend(EXAMPLES)
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_ilqr(monkeypatch, capsys, tmp_path):
    picture = tmp_path / "swing.png"
    out = run(monkeypatch, capsys, "ilqr.py", str(picture), "--steps", "20", "--iterations", "10")
    assert "iteration 10: cost" in out
    assert picture.stat().st_size > 10_000


def test_friction(monkeypatch, capsys, tmp_path):
    picture = tmp_path / "friction.png"
    load, few = msk_ray.load_config, ("env.nworld=4", "evaluation.nworld=4")
    monkeypatch.setattr(msk_ray, "load_config", lambda path, changes: load(path, [*changes, *few]))
    try:
        out = run(monkeypatch, capsys, "friction.py", str(picture), "--epochs", "2", "--values", "2")
    finally:
        sys.modules.pop("tray", None)
    assert "friction 0.8, as in the model: worst score" in out
    assert "friction 0.4 to 1.2, drawn for every episode: worst score" in out
    assert picture.stat().st_size > 10_000


def test_the_space_of_frictions_has_trials_with_and_without(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    try:
        trials = resolve_trials(load_space(EXAMPLES / "tray_friction.yaml"))
    finally:
        sys.modules.pop("tray", None)
    assert [trial.config.physics.randomize is None for trial in trials] == [True, False] * 5


def test_bouncing_ball(monkeypatch, capsys, tmp_path):
    picture = tmp_path / "ball.png"
    out = run(monkeypatch, capsys, "bouncing_ball.py", str(picture), "--worlds", "13")
    slopes = re.findall(r"mean slope ([\d.]+) by the backward pass, ([\d.]+) from end to end", out)
    (hard, wide), (soft, same) = [(float(a), float(b)) for a, b in slopes]
    assert hard > 1.8 * wide
    assert abs(soft - same) < 0.03 * same
    assert picture.stat().st_size > 10_000


def test_sysid(monkeypatch, capsys, tmp_path):
    picture = tmp_path / "arm.png"
    sizes = ("--trajectories", "2", "--steps", "12", "--iterations", "2")
    out = run(monkeypatch, capsys, "sysid.py", str(picture), *sizes)
    assert "exact derivatives: mean squared residual" in out
    assert picture.stat().st_size > 10_000


def test_muscle_fit(monkeypatch, capsys, tmp_path):
    picture = tmp_path / "muscle.png"
    out = run(monkeypatch, capsys, "muscle_fit.py", str(picture), "--angles", "5", "--iterations", "2")
    assert "iteration 2: root mean square of the residual" in out
    assert picture.stat().st_size > 10_000
