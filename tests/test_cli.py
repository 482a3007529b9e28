"""Commands as one would type them again."""

import bdb
import errno
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

import msk_ray
from msk_ray import __main__ as commands
from msk_ray.cli import Parser, run, typed_command
from msk_ray.errors import ConfigError


@pytest.mark.parametrize(
    ("argv", "command"),
    [
        (["/x/msk_ray/tune/__main__.py", "--space", "a b"], "python -m msk_ray.tune --space 'a b' --resume"),
        (["/x/msk_ray/train.py", "--set", "a=1", "--resume"], "python -m msk_ray.train --set a=1 --resume"),
        (["/x/bin/msk-ray", "tune"], "msk-ray tune --resume"),
        (["/x/own.py"], "python own.py --resume"),
        # Other folders on the way may be called so too: the checkout's, or that of somebody's own script.
        (["/x/msk_ray/msk_ray/tune/__main__.py"], "python -m msk_ray.tune --resume"),
        (["/msk_ray/msk_ray/x/msk_ray/train.py"], "python -m msk_ray.train --resume"),
        (["/x/msk_ray/msk_ray/__main__.py", "tune"], "python -m msk_ray tune --resume"),
        (["/x/msk_ray/.venv/bin/msk-ray", "tune"], "msk-ray tune --resume"),
        (["/x/msk_ray/.venv/lib/site-packages/pytest/__main__.py", "-q"], "python -m pytest -q --resume"),
        (["/x/msk_ray/.venv/bin/pytest"], "pytest --resume"),
        (["/x/msk_ray/own.py"], "python own.py --resume"),
    ],
)
def test_the_command_that_goes_on(argv: list[str], command: str) -> None:
    assert typed_command(argv, "--resume") == command


@pytest.mark.parametrize("checkout", ["msk_ray", "other"])
def test_the_command_of_a_checkout_runs_there(checkout: str, root: Path, tmp_path: Path) -> None:
    """Whatever its folder is called, the printed command names a module that Python finds."""
    folder = tmp_path / checkout
    folder.mkdir()
    (folder / "msk_ray").symlink_to(root / "msk_ray")
    code = "import sys; from msk_ray.cli import typed_command; print(typed_command([sys.argv[1]]))"
    environment = os.environ | {"PYTHONPATH": str(folder)}
    command = [sys.executable, "-c", code, str(folder / "msk_ray" / "tune" / "__main__.py")]
    shown = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder, env=environment).stdout
    assert shown == "python -m msk_ray.tune\n"


def test_an_error_is_one_harmless_line(capsys: pytest.CaptureFixture[str]) -> None:
    def main(argv: Sequence[str] | None) -> int:
        raise ConfigError("no setting 'a\x1b[2J\nall is well'")

    assert run(main) == 2
    assert capsys.readouterr().err == "error: no setting 'a\\x1b[2J\\nall is well'\n"
    with pytest.raises(SystemExit):
        Parser("x", "", "").parse_args(["\x1b[2J"])
    assert "\x1b" not in capsys.readouterr().err


def test_leaving_the_debugger_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def main(argv: Sequence[str] | None) -> int:
        raise bdb.BdbQuit

    assert run(main) == 130
    assert capsys.readouterr().err == "quit at a breakpoint\n"


def test_what_may_not_be_read_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def main(argv: Sequence[str] | None) -> int:
        raise PermissionError(errno.EACCES, "Permission denied", "/of/others")

    assert run(main, []) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: '/of/others': permission denied; name another")


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.main(["--version"]) == 0
    assert capsys.readouterr().out == f"msk_ray {msk_ray.__version__}\n"
