"""A tendon that just touches its wrapping geom: the arc has no length, and the gradient must stay finite."""

import mujoco
import numpy as np
import torch

from msk_ray.step import Simulation, TapePerSubstep
from msk_ray.step.autograd.tendon_lengths import Tendons
from msk_ray.step.forward import WorldBatch

# The straight path between both sites is tangent to the cylinder, in numbers that float32 holds exactly.
ARM = """<mujoco><option timestep="0.002"/><worldbody>
<geom name="w" type="cylinder" size=".25 .5"/><site name="a" pos=".25 1 0"/><site name="side" pos="1 0 0"/>
<body><joint name="j" axis="0 0 1"/><geom size=".1" pos="0 -1 0" mass="1"/><site name="b" pos=".25 -1 0"/></body>
</worldbody>
<tendon><spatial name="t"><site site="a"/><geom geom="w" sidesite="side"/><site site="b"/></spatial></tendon>
<actuator><muscle tendon="t" lengthrange="1 3" force="100"/></actuator></mujoco>"""


def rate(model: mujoco.MjModel, angle: float) -> float:
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = angle, 1.0
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    return float(data.ten_velocity[0])


def test_the_slope_of_the_rate_is_that_of_the_straight_path() -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    tendons = Tendons(WorldBatch(model, 1, 1, "cpu"))
    qpos = torch.zeros((1, 1), requires_grad=True)
    qvel = torch.ones((1, 1))
    length, speed = tendons(qpos, qvel)
    assert length.item() == 2.0
    (slope,) = torch.autograd.grad(speed.sum(), qpos)
    # The side on which the path comes clear of the cylinder.
    sides = [(rate(model, eps) - rate(model, 0.0)) / eps for eps in (1e-5, -1e-5)]
    assert min(abs(slope.item() - side) for side in sides) < 1e-3
    assert abs(sides[0] - sides[1]) > 0.01, "the two sides differ, or this would be no onset"


def test_a_step_at_the_onset_has_a_finite_gradient() -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    sim = Simulation(model, 1, 1, TapePerSubstep(), "cpu")
    inputs = [torch.full((1, n), value, requires_grad=True) for n, value in ((1, 0.5), (1, 0.0), (1, 0.1), (1, 0.5))]
    end = sim.step(*inputs)
    gradients = torch.autograd.grad(end.qvel.sum() + end.qpos.sum(), inputs)
    assert all(np.isfinite(g.numpy()).all() for g in gradients)
    assert gradients[1].abs().item() > 0
