"""What some tests need: without it they fail in CI and are skipped, with a reason, elsewhere. And what takes too long
to run always."""

import os
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from msk_ray.errors import DeviceError
from msk_ray.visualize.render import headless_backend


def need_program(*names: str, package: str) -> str:
    """The path of the first program there is; the test fails (in CI) or is skipped if there is none."""
    for name in names:
        path = shutil.which(name)
        if path is not None:
            return path
    return _missing(f"{names[0]} is not installed: apt install {package}")


def need_drawing() -> str:
    """The OpenGL platform that draws without a display here."""
    try:
        return headless_backend()
    except DeviceError as error:
        return _missing(str(error))


def missing_package(error: BaseException | None) -> str | None:
    """The package that is not installed, if that has caused an error; not one that a test only pretends to lack."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and error.name is not None:
            name = error.name.partition(".")[0]
            if name != "msk_ray" and name not in sys.modules and not _is_installed(name):
                return name
        error = error.__cause__ or error.__context__
    return None


def need_what_caused(error: BaseException) -> None:
    """Fail (in CI) or skip if a package that is not installed has caused an error; do nothing if something else has."""
    name = missing_package(error)
    if name is not None:
        _missing(f"{name} is not installed: make env")


def _is_installed(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def need_cpu_kernels() -> None:
    """Warp's compiler for the CPU, which an installation for GPUs alone may lack."""
    import warp as wp

    if not wp.is_cpu_available():
        _missing("Warp's compiler for the CPU is not installed: make env")


def slow(*values: object) -> list[Any]:
    """Values of a parameter, or tuples of several, that only `make test-all` tries: others go through the same code."""
    return [
        pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.slow) for value in values
    ]


def need_file(path: Path, command: str) -> Path:
    """`path`, if the file is there; `command` makes it."""
    return path if path.is_file() else Path(_missing(f"there is no {path}: {command}"))


def _missing(why: str) -> str:
    if os.environ.get("CI"):
        pytest.fail(why)
    pytest.skip(why, allow_module_level=True)
