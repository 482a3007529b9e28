"""Every command in the documentation has the options that it names, and the code of its pages runs."""

import re
import shlex
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from msk_ray import __main__ as commands
from msk_ray.config import load_config
from msk_ray.shipped import CONFIGS, SPACES, find_shipped
from msk_ray.sweep.space import find_space, load_space

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "policies" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
_COMMAND = re.compile(r"^(?:    )?(?:msk-ray |python -m msk_ray\.)(\S+)(?: (.*))?$")


def lines_of(page: Path) -> Iterator[str]:
    """Lines of code, indented or fenced, with those that go on in the next one joined."""
    fenced, begun = False, ""
    for line in page.read_text().splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            begun += line.strip() if begun else line
            if begun.endswith("\\"):
                begun = begun[:-1]
                continue
            yield begun
            begun = ""


def commands_of(page: Path) -> list[tuple[str, list[str]]]:
    """Commands of this package and their arguments."""
    found = [match for line in lines_of(page) if (match := _COMMAND.match(line))]
    return [(match[1], shlex.split(match[2] or "", comments=True)) for match in found]


def parser_of(name: str) -> Any:
    module = "msk_ray.tune.options" if name == "tune" else commands.commands()[name].module
    return import_module(module).parser()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_name_options_configs_and_spaces_that_exist(page: Path) -> None:
    for name, words in commands_of(page):
        args = parser_of(name).parse_args(words)
        config = getattr(args, "config", None)
        if config is not None and find_shipped(config, CONFIGS, ".yaml"):
            load_config(config, args.overrides)
        space = getattr(args, "space", None)
        if space is not None and find_shipped(space, SPACES, ".yaml"):
            load_space(find_space(space))


def test_they_are_found() -> None:
    found = [name for page in PAGES for name, _ in commands_of(page)]
    assert len(found) > 60
    assert set(found) >= {"list", "train", "tune", "evaluate", "play", "visualize", "export", "gradcheck", "diagnose"}
    assert set(found) >= {"gait", "status"}


def code_of(page: str) -> str:
    """The first block of Python of a page."""
    return (ROOT / "docs" / page).read_text().split("```python\n")[1].split("```")[0]


@pytest.mark.long
def test_the_code_on_identification_finds_the_damping(capsys: pytest.CaptureFixture[str]) -> None:
    found: dict[str, Any] = {}
    exec(code_of("step/identification.md"), found)
    assert found["guess"].exp().item() == pytest.approx(0.03, rel=0.02)


TINY = (
    *("env.nworld=4", "shac.horizon=4", "shac.critic_iterations=1", "shac.critic_batches=1", "trial.epochs=2"),
    *("evaluation.interval=1", "evaluation.nworld=2", "evaluation.steps=5", "actor.hidden=[8]", "critic.hidden=[8]"),
)


def test_the_commands_on_faults_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those that train; sweeps that are interrupted and resumed have tests of their own (tests/tune)."""
    monkeypatch.chdir(tmp_path)
    trained = [words for name, words in commands_of(ROOT / "docs" / "runner" / "faults.md") if name == "train"]
    assert [("--resume" in words) for words in trained] == [False, True]
    settings = [word for setting in TINY for word in ("--set", setting)]
    for words in trained:
        assert commands.main(["train", *words, *settings]) == 0, capsys.readouterr().err
    assert "resumed from" in capsys.readouterr().out
