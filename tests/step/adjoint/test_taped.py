"""The plain-Warp entry gives the gradient of the torch one."""

import mujoco
import numpy as np
import pytest
import warp as wp
from oracle import INPUTS, relative, simulate
from scenes import ant, ant_points, random_weights

from msk_ray.step.autograd.tape import TapePerSubstep
from msk_ray.step.forward import TapedStep, WarpState, WorldBatch


@pytest.mark.parametrize("integrator", [mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4])
def test_same_gradient_as_through_torch(integrator):
    model = ant()
    model.opt.integrator = integrator
    points = ant_points(model, 3, seed=2)
    weights = random_weights(model, 3, 5)
    _, expected, sim = simulate(model, TapePerSubstep(), points, 4, weights)

    step = TapedStep(WorldBatch(model, 3, 4, "cpu", tolerance=1e-12))
    arrays = {
        n: wp.array(np.stack([getattr(p, n) for p in points]).astype(np.float32), requires_grad=True) for n in INPUTS
    }
    with wp.Tape() as tape:
        end = step(arrays["ctrl"], WarpState(arrays["qpos"], arrays["qvel"], arrays["act"]), tape)
    qpos = wp.to_torch(end.qpos, requires_grad=False)
    raw = sim.tangent.lift(qpos, qpos.new_tensor(weights["qpos"]))
    seeds = {end.qpos: raw.numpy(), end.qvel: weights["qvel"].astype(np.float32)}
    tape.backward(grads={array: wp.array(np.ascontiguousarray(seed), dtype=float) for array, seed in seeds.items()})

    assert relative(arrays["ctrl"].grad.numpy(), expected["ctrl"]) < 1e-6
    assert relative(arrays["qvel"].grad.numpy(), expected["qvel"]) < 1e-6
    start = wp.to_torch(arrays["qpos"], requires_grad=False)
    tangent = sim.tangent.project(start, wp.to_torch(arrays["qpos"].grad))
    assert relative(tangent.numpy(), expected["qpos"]) < 1e-6


def test_two_steps_accumulate_into_a_shared_control():
    model = ant()
    points = ant_points(model, 2, seed=2)
    step = TapedStep(WorldBatch(model, 2, 1, "cpu"))
    ctrl = wp.array(np.stack([p.ctrl for p in points]).astype(np.float32), requires_grad=True)
    start = WarpState(
        *(wp.array(np.stack([getattr(p, n) for p in points]).astype(np.float32)) for n in ("qpos", "qvel", "act"))
    )
    ones = wp.array(np.ones((2, model.nv)), dtype=float)
    with wp.Tape() as tape:
        middle = step(ctrl, start, tape)
        end = step(ctrl, middle, tape)
    tape.backward(grads={end.qvel: ones})
    both = ctrl.grad.numpy().copy()
    ctrl.grad.zero_()
    with wp.Tape() as tape:
        end = step(ctrl, middle, tape)
    tape.backward(grads={end.qvel: ones})
    assert np.linalg.norm(both - ctrl.grad.numpy()) > 1e-3 * np.linalg.norm(both)
