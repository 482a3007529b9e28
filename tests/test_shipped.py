"""The wheel and the source distribution hold everything that an empty folder needs."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import msk_ray
from msk_ray import shipped
from msk_ray.config import load_config
from msk_ray.errors import ConfigError
from msk_ray.sweep.space import find_space, load_space

pytestmark = pytest.mark.long


def _build(source: Path, target: str, place: Path) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(place)]
    # Without the path of this checkout, so that nothing but `source` is built.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run(command, cwd=source, env=environment, check=True, capture_output=True)
    (made,) = place.iterdir()
    return made


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _build(Path(__file__).resolve().parent.parent, "wheel", tmp_path_factory.mktemp("wheel"))


def test_the_installed_wheel_works_in_an_empty_folder(wheel: Path, tmp_path: Path) -> None:
    site, home = tmp_path / "site", tmp_path / "home"
    home.mkdir()
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "install"]
    subprocess.run([*pip, "--no-index", "--no-deps", "--target", str(site), str(wheel)], check=True)

    def command(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, str(site / "bin" / "msk-ray"), *arguments],
            cwd=home,
            env=os.environ | {"PYTHONPATH": str(site)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "gradcheck" in command("--help")
    assert "22 trials" in command("tune", "--space", "ant_ablate", "--dry-run")
    assert not list(home.iterdir())


def test_the_source_distribution_builds_the_same_wheel(wheel: Path, root: Path, tmp_path: Path) -> None:
    made = _build(root, "sdist", tmp_path / "sdist")
    with tarfile.open(made) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (source,) = (tmp_path / "source").iterdir()
    assert source.name == f"msk_ray-{msk_ray.__version__}"
    assert not (source / "lab").exists(), "finished questions are not shipped"
    again = _build(source, "wheel", tmp_path / "again")
    with zipfile.ZipFile(wheel) as first, zipfile.ZipFile(again) as second:
        assert first.namelist() == second.namelist()
        for folder in ("configs", "tune_spaces", "policies"):
            for path in (p for p in (root / folder).rglob("*") if p.suffix in (".yaml", ".pt")):
                assert f"msk_ray/_data/{path.relative_to(root)}" in first.namelist()


def test_the_installed_folder_comes_before_the_checkout(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    package = tmp_path / "site" / "msk_ray"
    (package / "_data" / "configs").mkdir(parents=True)
    monkeypatch.setattr(shipped, "__file__", str(package / "shipped.py"))
    assert shipped.shipped_folder() == package / "_data"


def test_configs_and_spaces_are_found_from_anywhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_config("cartpole") == load_config("configs/cartpole.yaml")
    assert load_space(find_space("ant_ablate")).base_path.name == "ant.yaml"
    assert shipped.find_shipped("policies/cartpole.pt", "policies", ".pt") == shipped.find_shipped(
        "cartpole", "policies", ".pt"
    )
    assert shipped.find_shipped("README.md", "policies", ".pt") is None, "not everything beside the package"
    with pytest.raises(ConfigError, match=r"unknown config 'cartpol'; known: ant, .*cartpole.*or give a path"):
        load_config("cartpol")


def test_files_of_the_user_come_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for folder, text in (("configs", "env: {name: cartpole, nworld: 3}"), ("tune_spaces", "")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "cartpole.yaml").write_text(text)
    assert load_config("cartpole").env.nworld == 3
    assert load_config("configs/cartpole.yaml").env.nworld == 3
    assert find_space("cartpole") == tmp_path / "tune_spaces" / "cartpole.yaml"
