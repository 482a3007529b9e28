"""Verdicts of the table of models from elsewhere, on figures that are made up, and files that models lack."""

import runpy
from pathlib import Path
from typing import Any

import mujoco
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
EXACT = {
    "checked": 2,
    "kinks": 0,
    "mismatches": 0,
    "nonfinite": 0,
    "errors": [1e-5, 2e-4],
    "doubts": [0.0, 0.0],
    "approximated_share": 0.0,
    "solver_unconverged_share": 0.0,
    "solver_residual_max": 1e-6,
}
OFF = {"errors": [1e-5, 0.3]}
UNSOLVED = {"solver_unconverged_share": 1.0, "solver_residual_max": 0.5}
SAID = "the constraint solver stopped before it had converged in 50.0% of the substeps"
BALL = '<mujoco><worldbody>{}<body pos="0 0 1"><freejoint/><geom {}/></body></worldbody></mujoco>'


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The names of the benchmark."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return runpy.run_path(str(BENCHMARKS / "foreign.py"))


@pytest.mark.parametrize(
    ("figures", "told", "verdict"),
    [
        ({}, [], "right"),
        (OFF, [], "WRONG"),
        (OFF, ["the model may stop the solver: it runs with iterations 100 instead of 1"], "WRONG"),
        (OFF | {"approximated_share": 0.25}, [], "counted"),
        (OFF | {"doubts": [0.0, 0.5]}, [], "rounding"),
        (OFF | {"doubts": [0.0, 0.5], "nonfinite": 1}, [], "WRONG"),
        (OFF | {"doubts": [0.0, 0.2]}, [], "WRONG"),
        (OFF | {"solver_residual_max": 0.1}, [], "rounding"),
        (OFF | UNSOLVED, [], "WRONG"),
        (OFF | UNSOLVED, [SAID], "told"),
        (OFF, [SAID], "WRONG"),
        (UNSOLVED | {"checked": 0, "mismatches": 2, "errors": [], "doubts": []}, [], "WRONG"),
        (UNSOLVED | {"checked": 0, "mismatches": 2, "errors": [], "doubts": []}, [SAID], "told"),
        ({"checked": 0, "kinks": 2, "errors": [], "doubts": []}, [], "not compared"),
    ],
)
def test_verdicts(foreign: dict[str, Any], figures: dict[str, Any], told: list[str], verdict: str) -> None:
    """An error is wrong unless it is counted, told with its cause, or rounding; a model that is told of is not right
    for that."""
    kinds = {"standing": EXACT, "contact": EXACT | figures}
    if verdict == "not compared":
        kinds = {"contact": EXACT | figures}
    assert foreign["judged"](kinds, told, 1e-3)["verdict"] == verdict


def test_a_kind_of_state_that_fails_is_named(foreign: dict[str, Any]) -> None:
    """The other kind has the verdict."""
    found = foreign["judged"]({"standing": EXACT, "contact": {"failed": "diverged"}}, [], 1e-3)
    assert (found["verdict"], found["note"]) == ("right", "contact: diverged")


def test_files_are_taken_from_the_folder_that_has_most(foreign: dict[str, Any], tmp_path: Path) -> None:
    """Not from one that has a pointer of git in place of the file; one that is nowhere is named."""
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    for folder, names in (("one", ["a.obj"]), ("other", ["a.obj", "b.obj"]), ("robot", [])):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / name).write_text(corners)
    (tmp_path / "one" / "b.obj").write_text("version https://git-lfs.github.com/spec/v1\n")
    path = tmp_path / "robot" / "robot.xml"
    meshes = '<asset><mesh file="a.obj"/><mesh file="b.obj"/></asset>'
    path.write_text(BALL.format("", 'type="mesh" mesh="b"').replace("<worldbody>", meshes + "<worldbody>"))
    spec = mujoco.MjSpec.from_file(str(path))
    assert foreign["Files"]([tmp_path]).supply(spec) == []
    assert {Path(mesh.file).parent.name for mesh in spec.meshes} == {"other"}
    spec.compile()
    only = foreign["Files"]([tmp_path / "one"])
    assert foreign["compiled"](path, only) == "files missing: b.obj"


def test_a_file_that_is_included_may_be_in_another_folder(foreign: dict[str, Any], tmp_path: Path) -> None:
    """As in packages that download the robot of their scenes."""
    for folder in ("robot", "scene"):
        (tmp_path / folder).mkdir()
    (tmp_path / "robot" / "ball.xml").write_text(BALL.format("", 'size=".1"'))
    path = tmp_path / "scene" / "scene.xml"
    path.write_text('<mujoco><include file="ball.xml"/></mujoco>')
    assert "ball.xml" in foreign["compiled"](path, foreign["Files"]([tmp_path / "scene"]))
    model = foreign["compiled"](path, foreign["Files"]([tmp_path]))
    assert (model.nv, model.ngeom) == (6, 2)


def test_only_what_floats_stands_on_a_floor(foreign: dict[str, Any], tmp_path: Path) -> None:
    """One through the base of a hand would clamp it."""
    path = tmp_path / "hand.xml"
    path.write_text(BALL.format("", 'size=".1"'))
    assert foreign["compiled"](path, foreign["Files"]([])).ngeom == 2
    path.write_text(BALL.format("", 'size=".1"').replace("<freejoint/>", '<joint axis="0 1 0"/>'))
    assert foreign["compiled"](path, foreign["Files"]([])).ngeom == 1


def test_models_that_differ_in_the_solver_only_are_two(foreign: dict[str, Any]) -> None:
    """Equal ones count once, whatever their names."""
    xml = BALL.format("", 'size=".1"')
    few = xml.replace("<worldbody>", '<option iterations="1"/><worldbody>')
    named = xml.replace("<body ", '<body name="ball" ')
    one, other, same = (foreign["signature"](mujoco.MjModel.from_xml_string(text)) for text in (xml, few, named))
    assert one == same != other
