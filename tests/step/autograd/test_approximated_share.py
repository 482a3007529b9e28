"""How often a gradient goes through a contact without a derivative is counted, reported and warned of once.

A capsule lies along a cylinder: their sides are parallel.
"""

import warnings

import mujoco
import pytest
import torch

from msk_ray.step import Simulation, TapeAll, TapePerSubstep
from msk_ray.step.autograd.backward import Backward

BODIES = """<mujoco><option timestep=".002" gravity="0 0 0"/><worldbody>
<geom type="plane" size="1 1 1"/>
<body><freejoint/><geom name="can" type="{0}" size=".1 .1" euler="0 90 0"/></body>
<body><freejoint/><geom name="bar" type="capsule" size=".1 .1" euler="0 90 0"/></body></worldbody></mujoco>"""


def pull_back(sim: Simulation, heights: list[float], speeds: list[float], worlds_used: int | None = None) -> None:
    """One env step of two bodies above each other, their centres this far apart, and its pullback."""
    state = sim.initial_state()
    for world, (height, speed) in enumerate(zip(heights, speeds, strict=True)):
        state.qpos[world, 2] = 0.5
        state.qpos[world, 9] = 0.5 + height
        state.qvel[world, 8] = speed
    qpos = state.qpos.requires_grad_()
    end = sim.step(torch.zeros((sim.nworld, 0)), qpos, state.qvel, state.act)
    end.qvel[:worlds_used].sum().backward()


@pytest.mark.parametrize("mode", [TapePerSubstep, TapeAll])
def test_each_world_and_substep_counts_once(mode: type[Backward]) -> None:
    """Contact in world 0 in all 4 substeps; in world 1 from the third; none in world 2."""
    model = mujoco.MjModel.from_xml_string(BODIES.format("cylinder"))
    sim = Simulation(model, 3, 4, mode(), "cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert sim.diagnostics()["approximated_share"] == 0.0
    falling = 0.2 + 0.0012  # at 0.4 m/s, 0.8 mm a substep
    for _ in range(2):
        pull_back(sim, [0.198, falling, 0.5], [0.0, -0.4, 0.0])
    with pytest.warns(
        UserWarning, match=r"approximated in 50\.0% .* geom bar \(capsule\) with geom can \(cylinder\)"
    ) as told:
        assert sim.diagnostics()["approximated_share"] == pytest.approx(6 / 12)
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # once is enough
        pull_back(sim, [0.198, falling, 0.5], [0.0, -0.4, 0.0], worlds_used=1)
        assert sim.diagnostics()["approximated_share"] == pytest.approx(4 / 12)
        assert sim.diagnostics()["approximated_share"] == 0.0


def test_a_model_without_such_pairs_has_no_such_figure() -> None:
    sim = Simulation(mujoco.MjModel.from_xml_string(BODIES.format("capsule")), 1, 2, TapePerSubstep(), "cpu")
    pull_back(sim, [0.198], [0.0])
    assert "approximated_share" not in sim.diagnostics()
