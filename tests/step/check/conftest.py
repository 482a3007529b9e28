"""The cart-pole of `small_models`, compiled and as a file."""

from pathlib import Path

import mujoco
import pytest
from small_models import CARTPOLE


@pytest.fixture
def cartpole() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(CARTPOLE)


@pytest.fixture
def cartpole_file(tmp_path: Path) -> Path:
    path = tmp_path / "cartpole.xml"
    path.write_text(CARTPOLE)
    return path
