"""The measures of the house, on files small enough to count by hand."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from pydantic import BaseModel


@pytest.fixture
def house(root: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(str(root / "benchmarks"))
    yield importlib.import_module("house")
    for name in ("house", "record"):
        sys.modules.pop(name, None)


def test_every_line_has_one_kind(house: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text(
        '"""What it is.\n\nMore.\n"""\n\n# why\nx = 1  # not a comment line\n"""Of x."""\ny = """a\n# b"""\n'
    )
    assert house.lines_of(path) == {"docstrings": 5, "blank": 1, "comments": 1, "code": 3}


def test_every_folder_has_a_room(house: ModuleType) -> None:
    package = Path("msk_ray")
    rooms = [house.room_of(package / name, package) for name in ("robots/env.py", "legs/gait/body.py", "envs/base.py")]
    assert rooms == ["robots", "legs", "runner"]
    assert house.room_of(package / "step" / "check" / "check.py", package) == "step"
    assert house.room_of(package / "robots.py", package) == "runner", "a file is no room"


class Inner(BaseModel):
    low: float = 0.0
    high: float = 1.0


class Single(BaseModel):
    score: float = 0.0


class Outer(BaseModel):
    plain: int = 1
    either: int | Inner = 1
    many: dict[str, Inner] = {}
    single: Single | None = None


def test_settings_are_the_leaves(house: ModuleType) -> None:
    assert [key for key, _ in house.walk(Outer, "a")] == [
        *("a.plain", "a.either", "a.either.low", "a.either.high", "a.many.*.low", "a.many.*.high", "a.single"),
    ]
    assert ("a.many.*.low", "Inner.low") in list(house.walk(Outer, "a"))


def test_what_a_space_sets(house: ModuleType) -> None:
    grid = {"grid": [1, {"label": "growing", "value": {"start": 8, "end": 32}}]}
    found = house.set_by_space(
        {
            "question": "?",
            "overrides": {"trial.epochs": 3},
            "parameters": {"shac.horizon": grid},
            "ablate": {"variants": {"far": {"shac": {"gamma": 0.9}}}},
            "scheduler": {"kind": "asha"},
        }
    )
    assert found["trial"] == {
        *("trial.epochs", "shac.horizon", "shac.horizon.start", "shac.horizon.end", "shac.gamma"),
    }
    assert {"question", "scheduler.kind", "ablate.variants", "parameters"} <= found["space"]


def test_places_are_found_wherever_they_are(house: ModuleType, tmp_path: Path) -> None:
    package = tmp_path / "msk_ray" / "moved"
    package.mkdir(parents=True)
    (package / "list.py").write_text("LOGGERS = Registry()\n")
    assert house.places(tmp_path, (r"^LOGGERS = ", r"^GONE = ")) == ["moved/list.py"]


def test_every_place_that_an_extension_changes_is_in_this_checkout(house: ModuleType, root: Path) -> None:
    patterns = [each for group in (*house.EDITS.values(), house.FROM_CTRL_TO_KERNEL) for each in group]
    assert len(house.places(root, tuple(patterns))) == len(patterns)
