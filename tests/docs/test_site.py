"""The documentation site builds without a warning, loads nothing from elsewhere, and its pages' commands run."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from needs import slow

from msk_ray import __main__ as commands
from msk_ray.visualize import __main__ as visualize

pytestmark = pytest.mark.long

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
    pages = {path.relative_to(root / "docs") for path in (root / "docs").rglob("*.md")}
    pages |= {Path("benchmarks", path.name) for path in (root / "benchmarks" / "results").glob("*.md")}
    for page in pages:
        name = "index" if page.stem == "README" else page.stem
        assert (site / page.parent / f"{name}.html").is_file(), page
    reference = (site / "api.html").read_text()
    for name in ("simulation.Simulation.step", "policy.load_policy", "batched.BatchedEnv", "schema.Config.env"):
        assert f'.{name}"' in reference, name
    assert 'href="benchmarks/accuracy.html"' in (site / "index.html").read_text(), "links between files became links"
    assert "<code>tune_spaces/algorithms.yaml</code>" in (site / "runner" / "tune.html").read_text(), (
        "a file that is no page"
    )


def test_it_loads_nothing_from_elsewhere(site: Path) -> None:
    loaded = re.compile(r'<(?:script|link|img|iframe)\b[^>]*?(?:src|href)="?(?:https?:)?//[^">]+')
    found = {page.name: hits for page in site.rglob("*.html") if (hits := loaded.findall(page.read_text()))}
    assert not found
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    assert not re.search(r"url\(['\"]?https?:|@import", styles)


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    """Where the site is served."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            """Nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(site)))
    thread = Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.parametrize("width", [375, *slow(1280)])
def test_a_browser_finds_no_fault_and_scrolls_down_only(address: str, browser: Any, width: int) -> None:
    page = browser.new_page(viewport={"width": width, "height": 900})
    faults: list[str] = []
    page.on("console", lambda message: faults.append(message.text) if message.type in ("error", "warning") else None)
    page.on(
        "request", lambda request: None if request.url.startswith((address, "data:")) else faults.append(request.url)
    )
    page.on("response", lambda response: faults.append(response.url) if response.status >= 400 else None)
    for name in ("index", "api", "tutorials/bouncing_ball"):
        page.goto(f"{address}/{name}.html")
        assert page.evaluate("document.documentElement.scrollWidth") <= width, name
        assert page.locator("h1").count() == 1
    assert not faults
    page.close()


def _commands(page: Path) -> list[list[str]]:
    lines = re.findall(r"^    msk-ray (.*?)(?:  +#.*)?$", page.read_text(), re.MULTILINE)
    return [line.split() for line in lines]


def _smaller(words: list[str]) -> list[str]:
    """A command of the tour in tiny sizes, without pictures and sweeps, which have tests of their own."""
    options: dict[str, list[str]] = {
        "train": [word for setting in TINY for word in ("--set", setting)],
        "visualize": ["--steps", "5", "--device", "cpu"],
        "evaluate": ["--worlds", "2", "--steps", "5", "--device", "cpu"],
        "tune": [] if "--dry-run" in words else ["--dry-run"],
        "export": [],
    }
    drawn = {"--video", "--strip"} & set(words)
    if drawn:
        words = [*words[: words.index(drawn.pop())], "--no-render"]
    return [*words, *options[words[0]]]


def test_the_commands_of_the_tour_run(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    found = _commands(root / "docs" / "tour.md")
    assert [words[0] for words in found] == [
        *("visualize", "visualize", "train", "evaluate", "visualize", "train", "tune", "tune", "export"),
    ]
    for words in found:
        if words[0] == "visualize":
            visualize.parser().parse_args(words[1:])  # its options exist
        assert commands.main(_smaller(words)) == 0, (words, capsys.readouterr().err)
    for name in ("mine.pt", "mine.json", "mine.mjb"):
        assert (tmp_path / name).stat().st_size > 100


def test_the_code_of_the_page_on_gradients_runs(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = (root / "docs" / "step" / "gradients.md").read_text().split("```python\n")[1].split("```")[0]
    found: dict[str, Any] = {}
    exec(code, found)
    assert found["speed"].grad.item() == pytest.approx(0.5, rel=1e-4)
