"""Which Ray an experiment runs on."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from msk_ray.tune.options import parser

pytestmark = pytest.mark.long

ABSENT = "127.0.0.1:1"
"""Nobody listens there."""


@pytest.fixture
def ray_folder() -> Iterator[Path]:
    """Ray's folder, in which somebody's `ray start` has left a note of a cluster that is gone."""
    top = Path(tempfile.mkdtemp(prefix="note_", dir="/tmp"))  # sockets lie below, whose paths may have 107 bytes
    (top / "ray").mkdir()
    (top / "ray" / "ray_current_cluster").write_text(ABSENT)
    yield top
    shutil.rmtree(top)


def start(*arguments: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    inherited = {key: value for key, value in os.environ.items() if key != "RAY_ADDRESS"}
    return subprocess.run(
        [sys.executable, "-m", *arguments], env=inherited | environment, capture_output=True, text=True, timeout=300
    )


def test_a_stale_note_of_a_cluster_does_not_matter(ray_folder: Path) -> None:
    result = start("msk_ray.tune.ray_probe", RAY_TMPDIR=str(ray_folder))
    assert result.returncode == 0, result.stderr
    assert '"cpus"' in result.stdout
    assert [path.name for path in ray_folder.rglob("*")] == ["ray", "ray_current_cluster"]  # as it was


def test_a_named_cluster_that_is_not_there_is_refused(tmp_path: Path, root: Path) -> None:
    space = str(root / "tune_spaces" / "cartpole_smoke.yaml")
    result = start("msk_ray.tune", "--space", space, "--cpu", "--storage", str(tmp_path), RAY_ADDRESS=ABSENT)
    assert result.returncode == 2
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith(f"error: no Ray cluster at {ABSENT} (--address or RAY_ADDRESS): ")


def test_the_command_line_outranks_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", ABSENT)
    assert parser().parse_args(["--space", "x"]).address == ABSENT
    assert parser().parse_args(["--space", "x", "--address", "auto"]).address == "auto"
    monkeypatch.setenv("RAY_ADDRESS", "")
    assert parser().parse_args(["--space", "x"]).address is None
