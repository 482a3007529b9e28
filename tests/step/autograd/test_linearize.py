"""(A, B) of an env step against MuJoCo's own mjd_transitionFD in float64, chained over the substeps."""

import mujoco
import numpy as np
import pytest
import torch
from oracle import Point, differences, relative, rollout
from scenes import ant, ant_points, cartpole
from test_adjoint_features import SCENES, random_points

from msk_ray.errors import ConfigError
from msk_ray.step import Backward, FdJacobian, Hybrid, Simulation, TapeAll, TapePerSubstep
from msk_ray.step.autograd import tape as tape_module


def transition(model: mujoco.MjModel, point: Point, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """A and B of `substeps` steps: A = A_K … A_1, B = Σ A_K … A_{k+1} B_k."""
    data = rollout(model, point, 0)
    size = 2 * model.nv + model.na
    a, b = np.eye(size), np.zeros((size, model.nu))
    for _ in range(substeps):
        mujoco.mj_forward(model, data)
        one_a, one_b = np.zeros((size, size)), np.zeros((size, model.nu))
        mujoco.mjd_transitionFD(model, data, 1e-6, True, one_a, one_b, None, None)
        a, b = one_a @ a, one_a @ b + one_b
        mujoco.mj_step(model, data)
    return a, b


def linearized(model: mujoco.MjModel, points: list[Point], substeps: int, mode: Backward):
    sim = Simulation(model, len(points), substeps, mode, "cpu", tolerance=1e-12)
    inputs = [
        torch.tensor(np.stack([getattr(p, n) for p in points]), dtype=torch.float32)
        for n in ("ctrl", "qpos", "qvel", "act")
    ]
    return sim.linearize(*inputs), sim


@pytest.mark.parametrize("substeps", [1, 4])
def test_an_ant_in_contact_against_mujoco(substeps):
    model = ant("elliptic")
    points = ant_points(model, 6, seed=1)
    (a, b, end), _ = linearized(model, points, substeps, TapePerSubstep())
    errors = []
    for i, point in enumerate(points):
        expected_a, expected_b = transition(model, point, substeps)
        errors.append((relative(a[i].numpy(), expected_a), relative(b[i].numpy(), expected_b)))
        np.testing.assert_allclose(end.qpos[i], rollout(model, point, substeps).qpos, atol=1e-5)
    print(errors)
    assert np.max(errors) < 1e-4


def test_integrators_with_other_checkpoints():
    for integrator in (mujoco.mjtIntegrator.mjINT_RK4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST):
        model = cartpole()
        model.opt.integrator = integrator
        (point, *_) = cartpole_points()
        (a, b, _), _ = linearized(model, [point], 2, TapePerSubstep())
        for row in range(4):  # mjd_transitionFD knows no RK4
            unit = np.eye(4)[row]
            weights = {"qpos": unit[:2], "qvel": unit[2:], "act": unit[4:]}
            expected, _ = differences(model, point, 2, weights)
            assert relative(a[0, row].numpy(), np.concatenate([expected["qpos"], expected["qvel"]])) < 1e-4
            assert relative(b[0, row].numpy(), expected["ctrl"]) < 1e-4


def test_activations_and_balls_are_ordered_as_by_mujoco():
    for name in ("fast_muscle", "weld_sites"):
        model = SCENES[name]()
        points = random_points(model, 2, seed=9)
        (a, b, _), _ = linearized(model, points, 2, TapeAll())
        for i, point in enumerate(points):
            expected_a, expected_b = transition(model, point, 2)
            assert a.shape[1:] == expected_a.shape
            assert relative(a[i].numpy(), expected_a) < 1e-4
            if model.nu:
                assert relative(b[i].numpy(), expected_b) < 1e-4


class OneByOne(TapePerSubstep):
    """A mode that leaves `jacobian` to the base class."""

    jacobian = Backward.jacobian


def cartpole_points() -> list[Point]:
    parts = [([0.1 * i, 0.4], [1.0, -0.3], [], [0.2]) for i in range(3)]
    return [Point(*(np.asarray(v, np.float32).astype(float) for v in part)) for part in parts]


def test_all_modes_agree(monkeypatch):
    model, points = cartpole(), cartpole_points()
    (exact, control, _), _ = linearized(model, points, 4, TapePerSubstep())
    approximate = linearized(model, points, 4, FdJacobian(max_worlds=12))[0]
    torch.testing.assert_close(approximate.A, exact, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(approximate.B, control, rtol=1e-3, atol=1e-3)
    mixed = linearized(model, points, 4, Hybrid(TapePerSubstep(), FdJacobian(max_worlds=12)))[0]
    torch.testing.assert_close(mixed.A, exact)
    torch.testing.assert_close(mixed.B, approximate.B)
    # Three rows at once, the last chunk with one; bounds on gradients; one row at a time.
    monkeypatch.setattr(tape_module, "JACOBIAN_WORLDS", 9)
    for mode in (TapeAll(), TapePerSubstep(substep_grad_clip=1e-6), OneByOne()):
        a, b, _ = linearized(model, points, 4, mode)[0]
        torch.testing.assert_close(a, exact, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(b, control, rtol=1e-5, atol=1e-6)


def test_a_second_state_and_a_gradient_in_between():
    """Recorded passes do not keep anything of an earlier call."""
    model, points = cartpole(), cartpole_points()
    (first, _, _), sim = linearized(model, points, 2, TapePerSubstep())
    start = sim.initial_state()
    ctrl = torch.full((3, 1), 0.5, requires_grad=True)
    (found,) = torch.autograd.grad(sim.step(ctrl, *start).qvel.sum(), ctrl)
    again = sim.linearize(ctrl.detach(), *start)
    torch.testing.assert_close(again.B[:, 2:].sum(1), found, rtol=1e-5, atol=1e-6)
    assert (again.A - first).abs().max() > 1e-3


def test_without_a_backward_mode_it_is_refused():
    sim = Simulation(cartpole(), 1, 1, None, "cpu")
    with pytest.raises(ConfigError, match="without a backward mode"):
        sim.linearize(torch.zeros(1, 1), *sim.initial_state())
