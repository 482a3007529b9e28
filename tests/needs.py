"""What some tests need beyond Python packages: without it they fail in CI and are skipped, with a reason, elsewhere.
And what takes too long to run always."""

import os
import shutil
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


def slow(*values: object) -> list[Any]:
    """Values of a parameter that only `make test-all` tries: others go through the same code."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def need_file(path: Path, command: str) -> Path:
    """`path`, if the file is there; `command` makes it."""
    return path if path.is_file() else Path(_missing(f"there is no {path}: {command}"))


def _missing(why: str) -> str:
    if os.environ.get("CI"):
        pytest.fail(why)
    pytest.skip(why)
