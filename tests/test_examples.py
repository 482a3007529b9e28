"""The examples of the documentation run, in tiny size."""

import runpy
import sys
from pathlib import Path

import matplotlib

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"


def run(monkeypatch, capsys, name: str, *arguments: str) -> str:
    """Run an example as its own program, in this process; returns what it printed."""
    matplotlib.use("Agg")
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_ilqr(monkeypatch, capsys, tmp_path):
    picture = tmp_path / "swing.png"
    out = run(monkeypatch, capsys, "ilqr.py", str(picture), "--steps", "20", "--iterations", "10")
    assert "iteration 10: cost" in out
    assert picture.stat().st_size > 10_000
