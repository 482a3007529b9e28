"""An environment from outside: one file that the package does not know goes through every command, as ours do.

`tune` runs once as the console script does, in a folder of the user's; all else runs in this process.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from needs import need_drawing
from processes import Launcher

from msk_ray.__main__ import main
from msk_ray.config import dump_yaml

HERE = Path(__file__).resolve().parent
SCRIPT = """
import contextlib, sys
from msk_ray.__main__ import main
if __name__ == "__main__":
    ray = contextlib.nullcontext()
    if sys.argv[1] == "tune":
        from lean_ray import lean_ray
        ray = lean_ray()
    with ray:
        sys.exit(main())
"""
SETTINGS = {
    "env": {"name": "hopper:Hopper", "nworld": 8, "episode_length": 40, "reward": {"forward": 2.0}},
    "shac": {"horizon": 4, "critic_iterations": 2, "critic_batches": 2},
    "actor": {"hidden": [16]},
    "critic": {"hidden": [16]},
    "evaluation": {"interval": 1, "nworld": 4, "steps": 20},
    "trial": {"epochs": 2},
    "execution": {"checkpoint_interval": 1},
}
SPACE = {
    "question": "Which rate?",
    "base": "hopper.yaml",
    "parameters": {"env.reward.upright": {"grid": [0.5]}},
    "seeds": "0",
}

pytestmark = [pytest.mark.timeout(3600), pytest.mark.long]  # on a busy machine

Command = Callable[..., "subprocess.CompletedProcess[str]"]


def _folder(place: Path) -> Path:
    """A user's folder, with settings and a space of the hopper."""
    place.mkdir()
    (place / "hopper.yaml").write_text(dump_yaml(SETTINGS))
    (place / "hopper_rates.yaml").write_text(dump_yaml(SPACE))
    return place


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Command]:
    """Runs `msk-ray ARGUMENTS` in this process, in the folder `user` of `tmp_path`."""

    def command(*arguments: str) -> "subprocess.CompletedProcess[str]":
        monkeypatch.chdir(tmp_path / "user")
        monkeypatch.syspath_prepend(tmp_path / "user")
        capsys.readouterr()
        code = main(arguments)
        said = capsys.readouterr()
        return subprocess.CompletedProcess(arguments, code, said.out + said.err, "")

    yield command
    sys.modules.pop("hopper", None)


@pytest.fixture
def user(tmp_path: Path, root: Path, launcher: Launcher) -> Command:
    """Runs `msk-ray ARGUMENTS` as its script does, in a folder that holds the hopper."""
    place = _folder(tmp_path / "user")
    (place / "hopper.py").write_text((HERE / "hopper.py").read_text())
    script = place / "bin" / "msk-ray"
    script.parent.mkdir()
    script.write_text(SCRIPT)
    paths = {"PYTHONPATH": os.pathsep.join(map(str, (root, HERE.parent / "tune")))}

    def command(*arguments: str) -> "subprocess.CompletedProcess[str]":
        process = launcher.start(
            [sys.executable, str(script), *arguments],
            cwd=place,
            env=os.environ | paths,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        output, _ = process.communicate()
        return subprocess.CompletedProcess(arguments, process.returncode, output, "")

    return command


def _done(result: "subprocess.CompletedProcess[str]") -> str:
    assert result.returncode == 0, result.stdout
    return result.stdout


def test_it_is_one_short_file_that_the_package_does_not_know(root: Path) -> None:
    assert len((HERE / "hopper.py").read_text().splitlines()) <= 60
    for path in (root / "msk_ray").rglob("*.py"):
        assert "hopper:Hopper" not in path.read_text(), path


def test_by_import_path_it_trains_and_is_shown_measured_and_diagnosed(here: Command, tmp_path: Path) -> None:
    home = _folder(tmp_path / "user")
    (home / "hopper.py").write_text((HERE / "hopper.py").read_text())
    _done(here("train", "--config", "hopper.yaml", "--device", "cpu"))
    trial = home / "runs" / "train" / "hopper_seed0"
    assert "no module 'hopper'" not in _done(here("train", "--config", "hopper.yaml", "--device", "cpu", "--resume"))
    text = _done(here("evaluate", str(trial), "--device", "cpu", "--worlds", "4"))
    for term in ("forward", "upright", "effort", "impact"):
        assert term in text
    quality = ("--horizons", "1", "2", "--worlds", "2", "--directions", "4", "--states", "standing")
    _done(here("diagnose", str(trial / "checkpoints" / "best.pt"), *quality, "--output", "quality"))
    assert list((home / "quality").glob("*.png"))
    refused = here("gait", str(trial), "--device", "cpu")
    assert (refused.returncode, "gait needs a model of two legs" in refused.stdout) == (2, True), refused.stdout
    need_drawing()
    pictures = ("--device", "cpu", "--steps", "10", "--size", "64x48")
    _done(here("visualize", str(trial), "--video", "hopper.mp4", "--strip", "hopper.png", *pictures))
    assert (home / "hopper.mp4").stat().st_size > 500
    assert (home / "hopper.png").stat().st_size > 500


def test_by_import_path_it_is_swept_and_reported(user: Command, here: Command, tmp_path: Path) -> None:
    runs = tmp_path / "user" / "runs"
    assert "1 trials" in _done(here("tune", "--space", "hopper_rates.yaml", "--dry-run"))
    misspelt = here("tune", "--space", "hopper_rates.yaml", "--dry-run", "--set", "env.reward.efort=1")
    assert (misspelt.returncode, "did you mean 'effort'?" in misspelt.stdout) == (2, True), misspelt.stdout
    _done(user("tune", "--space", "hopper_rates.yaml", "--cpu"))
    trials = [json.loads(path.read_text()) for path in runs.glob("hopper_rates/trials/*/outcome.json")]
    assert [entry["outcome"] for entry in trials] == ["finished"], trials
    assert "hopper_rates" in _done(here("status", "hopper_rates"))
    _done(here("report", "hopper_rates", "--device", "cpu"))
    assert "env.reward.upright" in (runs / "hopper_rates" / "report" / "index.html").read_text()


def test_installed_as_a_wheel_it_has_a_short_name(
    here: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, site = tmp_path / "source", tmp_path / "site"
    source.mkdir()
    (source / "hopper.py").write_text((HERE / "hopper.py").read_text())
    (source / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["setuptools"]\nbuild-backend = "setuptools.build_meta"\n'
        '[project]\nname = "my-hopper"\nversion = "1.0"\n'
        '[project.entry-points."msk_ray.envs"]\nspringy = "hopper:Hopper"\n'
        '[tool.setuptools]\npy-modules = ["hopper"]\n'
    )
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    apart = ("--no-index", "--no-deps", "--no-build-isolation")
    subprocess.run([*pip, "wheel", *apart, "--wheel-dir", str(tmp_path), str(source)], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    subprocess.run([*pip, "install", *apart, "--target", str(site), str(wheel)], check=True)
    monkeypatch.syspath_prepend(site)
    place = _folder(tmp_path / "user")
    misspelt = here("train", "--config", "hopper.yaml", "--set", "env.name=sprngy")
    assert (misspelt.returncode, "did you mean 'springy'?" in misspelt.stdout) == (2, True), misspelt.stdout
    _done(here("train", "--config", "hopper.yaml", "--device", "cpu", "--set", "env.name=springy"))
    rows = (place / "runs" / "train" / "hopper_springy_seed0" / "metrics.jsonl").read_text().splitlines()
    assert len(rows) == 3  # the untrained policy, and two epochs
