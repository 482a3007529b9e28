"""A gait whose figures are known: made, not simulated."""

import runpy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from msk_ray.visualize.render import States

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body>
      <freejoint/>
      <geom type="sphere" size="0.1" mass="1"/>
      <body>
        <joint name="swings" axis="0 1 0" range="-1 1"/>
        <geom type="capsule" fromto=".1 0 0 .2 0 0" size=".02"/>
      </body>
      <body>
        <joint name="locked" axis="0 1 0" range="-1 1"/>
        <geom type="capsule" fromto="-.1 0 0 -.2 0 0" size=".02"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_figures_of_a_made_gait(monkeypatch: pytest.MonkeyPatch) -> None:
    """2 m/s along x, bouncing clear of the ground for half of each second, one joint at 3 Hz, one at its upper end."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    benchmark: dict[str, Any] = runpy.run_path(str(BENCHMARKS / "ant_gaits.py"))
    timestep = 0.02
    seconds = np.arange(1025) * timestep
    qpos = np.zeros((len(seconds), 9))
    qpos[:, 0] = 2.0 * seconds
    qpos[:, 2] = np.where(seconds % 1.0 < 0.499, 0.05, 2.0)
    qpos[:, 3] = 1.0
    qpos[:, 7] = 0.5 * np.sin(2 * np.pi * 3.0 * seconds)
    qpos[:, 8] = 0.98
    none = np.zeros((len(seconds), 0))
    found = benchmark["gait"](States(mujoco.MjModel.from_xml_string(MODEL), qpos, none, none, none), timestep)
    assert found.vx == pytest.approx(2.0)
    assert found.flight == pytest.approx(0.5, abs=0.01)
    assert found.rate == pytest.approx(3.0, abs=0.03)
    assert found.at_end == pytest.approx([0.0, 1.0])
    # Mean of |0.5 sin| is 1/π.
    assert found.past == pytest.approx([1 / np.pi - 1.0, -0.02], abs=2e-3)
