"""The documentation site builds without a warning, loads nothing from elsewhere, and its pages' commands run."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from needs import need_drawing

from msk_ray import __main__ as commands

TINY = (
    *("env.nworld=4", "shac.critic_iterations=1", "shac.critic_batches=1", "actor.hidden=[8]", "critic.hidden=[8]"),
    *("trial.epochs=2", "evaluation.interval=1", "evaluation.nworld=2", "evaluation.steps=10"),
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = Path(__file__).resolve().parents[2]
    place = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    command += ["--config-file", str(root / "docs" / "site" / "mkdocs.yml"), "--site-dir", str(place)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, env=environment, cwd=place, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return place


def test_it_has_every_page_and_the_reference(site: Path, root: Path) -> None:
    pages = [*(root / "docs").glob("*.md"), *(root / "benchmarks" / "results").glob("*.md")]
    for page in pages:
        folder = site / "benchmarks" if page.parent.name == "results" else site
        assert (folder / f"{page.stem}.html").is_file(), page
    reference = (site / "api.html").read_text()
    for name in ("simulation.Simulation.step", "policy.load_policy", "batched.BatchedEnv", "schema.Config.env"):
        assert f'.{name}"' in reference, name
    assert 'href="benchmarks/epoch.html"' in (site / "index.html").read_text(), "links between files became links"
    assert "<code>msk_ray/envs/floor.py</code>" in (site / "suite.html").read_text(), "a file that is no page"


def test_it_loads_nothing_from_elsewhere(site: Path) -> None:
    loaded = re.compile(r'<(?:script|link|img|iframe)\b[^>]*?(?:src|href)="?(?:https?:)?//[^">]+')
    found = {page.name: hits for page in site.rglob("*.html") if (hits := loaded.findall(page.read_text()))}
    assert not found
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    assert not re.search(r"url\(['\"]?https?:|@import", styles)


def _commands(page: Path) -> list[list[str]]:
    lines = re.findall(r"^    msk-ray (.*?)(?:  +#.*)?$", page.read_text(), re.MULTILINE)
    return [line.split() for line in lines]


def _smaller(words: list[str]) -> list[str]:
    """A command of the tour in tiny sizes."""
    options: dict[str, list[str]] = {
        "train": [word for setting in TINY for word in ("--set", setting)],
        "visualize": ["--steps", "5", "--device", "cpu"],
        "evaluate": ["--worlds", "2", "--steps", "5", "--device", "cpu"],
        # Sweeps are run by tests of their own.
        "tune": [] if "--dry-run" in words else ["--dry-run"],
        "export": [],
    }
    small = ["--size", "64x48"] if "--video" in words or "--strip" in words else []
    return [*words, *options[words[0]], *small]


def test_the_commands_of_the_tour_run(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    need_drawing()
    monkeypatch.chdir(tmp_path)
    found = _commands(root / "docs" / "tour.md")
    assert [words[0] for words in found] == [
        *("visualize", "visualize", "train", "evaluate", "visualize", "train", "tune", "tune", "export"),
    ]
    for words in found:
        assert commands.main(_smaller(words)) == 0, (words, capsys.readouterr().err)
    for name in ("swing.mp4", "mine.png", "mine.pt", "mine.json"):
        assert (tmp_path / name).stat().st_size > 100


def test_the_code_of_the_page_on_gradients_runs(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = (root / "docs" / "gradients.md").read_text().split("```python\n")[1].split("```")[0]
    found: dict[str, Any] = {}
    exec(code, found)
    assert found["speed"].grad.item() == pytest.approx(0.5, rel=1e-4)
