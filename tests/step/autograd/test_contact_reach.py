"""Contact before touching: a gradient of approaching pairs in the backward pass, beside an unchanged step."""

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.config import PhysicsConfig
from msk_ray.step import Simulation, TapeAll, TapePerSubstep
from msk_ray.step.autograd.hybrid import Hybrid
from msk_ray.step.autograd.modes import configured_backward

REACH = 0.05
SHAPES = {"sphere": "size='.1'", "mesh": "type='mesh' mesh='wedge'", "ellipsoid": "type='ellipsoid' size='.1 .1 .1'"}


def above_a_box(shape: str) -> mujoco.MjModel:
    """A body on a slide above a box; it rests on the box at 0.2."""
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep=".002" gravity="0 0 0"/>
        <asset><mesh name="wedge" vertex="-.1 -.1 .1 .1 -.1 .1 0 .1 .1 0 0 -.1"/></asset>
        <worldbody><geom type="box" size=".5 .5 .1"/><body><joint type="slide" axis="0 0 1"/>
        <geom {SHAPES[shape]} mass="2"/></body></worldbody></mujoco>"""
    )


def slope_of_velocity(sim: Simulation, heights: list[float]) -> np.ndarray:
    """∂(velocity after one step)/∂(height), by world."""
    qpos = torch.tensor(heights)[:, None].requires_grad_()
    rest = torch.zeros((len(heights), 1))
    end = sim.step(torch.zeros((len(heights), 0)), qpos, rest, torch.zeros((len(heights), 0)))
    end.qvel.sum().backward()
    assert qpos.grad is not None
    return qpos.grad[:, 0].numpy()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("mode", [TapePerSubstep, TapeAll])
def test_the_slope_fades_in_towards_the_touch(shape: str, mode: type[TapePerSubstep | TapeAll]) -> None:
    """By hand: m v' = h f(d), ∂f/∂d = -κ (1 - d/r), κ = k imp²/((1 - imp) w), k = 1/(0.95² 0.02²), imp = 0.9."""
    model = above_a_box(shape)
    sim = Simulation(model, 4, 1, mode(contact_reach=REACH), "cpu", tolerance=1e-9)
    gaps = [0.01, 0.04, 0.06, 1.0]
    found = slope_of_velocity(sim, [0.2 + gap for gap in gaps])
    kappa = 0.9**2 / (1 - 0.9) / (0.95 * 0.02) ** 2 / model.body_invweight0[1, 0]
    expected = [-0.002 * kappa / 2.0 * max(0.0, 1 - gap / REACH) for gap in gaps]
    np.testing.assert_allclose(found, expected, rtol=1e-3)
    assert sim.diagnostics()["reached_share"] == pytest.approx(2 / 4)


def test_the_step_stays_as_it_is() -> None:
    model = above_a_box("mesh")
    ends = []
    for reach in (None, REACH):
        sim = Simulation(model, 3, 8, TapePerSubstep(contact_reach=reach), "cpu")
        qpos = torch.tensor([[0.199], [0.21], [0.24]])
        ends.append(sim.step(torch.zeros((3, 0)), qpos, torch.full((3, 1), -1.0), torch.zeros((3, 0))))
        assert ("reached_share" in sim.diagnostics()) == (reach is not None)
    assert torch.equal(ends[0].qpos, ends[1].qpos)
    assert torch.equal(ends[0].qvel, ends[1].qvel)


def test_without_a_reach_there_is_no_slope() -> None:
    sim = Simulation(above_a_box("sphere"), 1, 1, TapePerSubstep(), "cpu")
    assert slope_of_velocity(sim, [0.21]) == 0.0


def test_the_configured_mode_has_it() -> None:
    hybrid = configured_backward(PhysicsConfig(backward="hybrid", contact_reach=REACH))
    assert isinstance(hybrid, Hybrid)
    assert hybrid.contact_reach == configured_backward(PhysicsConfig(contact_reach=REACH)).contact_reach == REACH
