"""The tutorials run cell by cell, in tiny sizes, and their notebooks were made from the sources as they are now."""

import shutil
from pathlib import Path
from typing import Any

import jupytext
import matplotlib
import matplotlib.pyplot as plt
import pytest

from msk_ray.experiment.manifest import Experiment

pytestmark = pytest.mark.long

TUTORIALS = Path(__file__).resolve().parents[2] / "docs" / "tutorials"
SOURCES = sorted(TUTORIALS.glob("*.py"))
LARGEST = 400_000
"""Bytes of a notebook with its pictures."""


def run(name: str, **tiny: Any) -> dict[str, Any]:
    """Execute the cells of a tutorial one after the other, with other parameters; returns its variables."""
    matplotlib.use("Agg")
    variables: dict[str, Any] = {"__name__": "__main__"}
    try:
        for cell in jupytext.read(TUTORIALS / f"{name}.py").cells:
            if cell.cell_type != "code":
                continue
            exec(compile(cell.source, name, "exec"), variables)
            if "parameters" in cell.metadata.get("tags", ()):
                assert tiny.keys() <= variables.keys(), "parameters that there are"
                variables |= tiny
    finally:
        plt.close("all")
    return variables


def test_bouncing_ball() -> None:
    found = run("bouncing_ball", WORLDS=13, ITERATIONS=3, FALL=40)
    hard, soft = (slopes.mean() for slopes in found["slopes"].values())
    assert hard > 1.8 * soft, "too steep where the force jumps"
    hard, soft = (errors[-1] for errors in found["errors"].values())
    assert soft < 0.1 * hard, "the right slope leads to the target"
    assert found["last"].median() > 3.0, "it grows with every pin"


def test_muscles() -> None:
    found = run("muscles", ANGLES=8, STEPS=8, ITERATIONS=60)
    assert found["whole"][found["probe"]].item() == pytest.approx(found["difference"], rel=0.05)
    assert found["without"].norm() < 0.6 * found["whole"].norm(), "activation carries most of it"
    assert found["history"][-1] == pytest.approx(found["TRUE"], rel=0.1)


def test_sweep(sweep: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """With a sweep that has run already: running one has tests of its own."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(sweep.path, tmp_path / "runs" / "rates")
    (tmp_path / "runs" / "rates" / "report").mkdir(exist_ok=True)
    sizes = ["env.nworld=4", "shac.horizon=4", "shac.critic_iterations=1", "shac.critic_batches=1", "trial.epochs=2"]
    small = [*sizes, "evaluation.interval=1", "evaluation.nworld=2", "evaluation.steps=5"]
    found = run("sweep", SMALL=small)
    assert len(found["scores"]) == 2
    assert len(found["colours"]) == 2, "a colour for each rate"
    out = capsys.readouterr().out
    assert "6 trials" in out, "of the dry run"
    assert "actor_lr" in out


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_notebooks_are_those_of_the_sources_and_whole(source: Path) -> None:
    path = source.with_suffix(".ipynb")
    made, wanted = jupytext.read(path), jupytext.read(source)
    assert [(cell.cell_type, cell.source) for cell in made.cells] == [
        (cell.cell_type, cell.source) for cell in wanted.cells
    ], "make notebooks"
    assert path.stat().st_size < LARGEST
    assert all(cell.get("execution_count") for cell in made.cells if cell.cell_type == "code")
    assert any("image/png" in out.get("data", {}) for cell in made.cells for out in cell.get("outputs", []))
