"""A missing program or package fails in CI and is a named reason to skip elsewhere."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from needs import missing_package, need_program, slow

from msk_ray.errors import ConfigError


def test_what_is_missing_fails_in_ci_and_is_skipped_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match="nothing-like-it is not installed: apt install it"):
        need_program("nothing-like-it", package="it")
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="nothing-like-it is not installed: apt install it"):
        need_program("nothing-like-it", package="it")
    assert need_program("nothing-like-it", "sh", package="it").endswith("sh")


def cause_of(name: str) -> Exception:
    try:
        try:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        except ModuleNotFoundError:
            raise ConfigError("install it") from None
    except ConfigError as error:
        return error


def test_only_what_is_not_installed_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert missing_package(cause_of("nothing_like_it.inside")) == "nothing_like_it"
    assert missing_package(cause_of("json.nothing_like_it")) is None
    assert missing_package(cause_of("msk_ray.nothing_like_it")) is None, "a mistake of ours"
    assert missing_package(ValueError("no module named json")) is None
    monkeypatch.setitem(sys.modules, "colorsys", None)
    assert missing_package(cause_of("colorsys")) is None, "a test pretends that it is missing"


@pytest.mark.long
@pytest.mark.parametrize(("ci", "code"), [("true", 2), *slow(("", 5))])
def test_gpu_tests_are_collected_without_optional_packages(root: Path, ci: str, code: int) -> None:
    """Fails, with "errors during collection" and no test run, where a file's import of one is an error."""
    files = ["tests/gym/test_gym.py", "tests/visualize/test_visualize.py", "tests/export/test_export.py"]
    environment = os.environ | {
        "HIDDEN": "gymnasium,av,onnxruntime",
        "CI": ci,
        "PYTHONPATH": f"{root / 'tests'}:{root}",
    }
    command = [sys.executable, "-m", "pytest", "-p", "hidden_packages", "-p", "no:timeout", "-m", "gpu", *files]
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    assert done.returncode == code, done.stdout
    for package in ("gymnasium", "av", "onnxruntime"):
        assert f"{package} is not installed: make env" in done.stdout
