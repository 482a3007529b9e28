"""Exact gradients of whole env steps against float64 central differences of C MuJoCo."""

import mujoco
import numpy as np
import pytest
import torch
from oracle import INPUTS, Point, differences, relative, rollout, simulate
from scenes import ant, ant_points, cartpole, random_weights
from test_adjoint_features import SCENES, random_points

from msk_ray.errors import UnsupportedModelError
from msk_ray.step import FdJacobian, Simulation
from msk_ray.step.autograd.hybrid import Hybrid
from msk_ray.step.autograd.tape import TapeAll, TapePerSubstep


def float32(*values: np.ndarray) -> Point:
    """Rounded to float32, so that both sides start from the same numbers."""
    return Point(*(np.asarray(v, dtype=np.float32).astype(float) for v in values))


def errors_of(model, points, substeps, mode):
    """Relative error by input over the states that are no kink and where the Warp forward agrees; and how many."""
    weights = random_weights(model, len(points), 3)
    end, found, _ = simulate(model, mode, points, substeps, weights)
    errors = {name: [] for name in INPUTS}
    for i, point in enumerate(points):
        expected, kink = differences(model, point, substeps, {n: w[i] for n, w in weights.items()})
        ahead = float(np.abs(end.qvel[i].detach().numpy() - rollout(model, point, substeps).qvel).max())
        if kink < 1e-2 and ahead < 1e-3:
            for name in INPUTS:
                errors[name].append(relative(found[name][i], expected[name]))
    return errors, len(errors["qpos"])


@pytest.mark.parametrize(("substeps", "contacts"), [(1, True), (16, True), (16, False)])
def test_cartpole(substeps, contacts):
    model = cartpole()
    if not contacts:  # then there is no room for any rows
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    rng = np.random.default_rng(0)
    points = [
        float32(rng.normal(size=2), rng.normal(size=2), np.zeros(0), rng.uniform(-0.9, 0.9, size=1)) for _ in range(6)
    ]
    errors, kept = errors_of(model, points, substeps, TapePerSubstep())
    assert kept == 6
    assert max(max(errors[n]) for n in INPUTS) < 1e-5


@pytest.mark.long
@pytest.mark.parametrize("substeps", [1, 16])
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_ant_in_contact(cone, substeps):
    model = ant(cone)
    points = ant_points(model, 20, seed=1)
    errors, kept = errors_of(model, points, substeps, TapePerSubstep())
    assert kept >= 15
    print({n: (np.median(e), max(e)) for n, e in errors.items()}, kept)
    assert np.median(errors["ctrl"]) < 1e-5
    assert np.median(errors["qvel"]) < 1e-5
    assert np.median(errors["qpos"]) < 1e-4
    assert max(max(errors[n]) for n in INPUTS) < 1e-2


def test_both_tapes_give_the_same_gradient():
    model = ant("elliptic")
    points = ant_points(model, 4, seed=2)
    weights = random_weights(model, 4, 5)
    _, one, _ = simulate(model, TapePerSubstep(), points, 8, weights)
    _, other, _ = simulate(model, TapeAll(), points, 8, weights)
    for name in INPUTS:
        assert relative(one[name], other[name]) < 1e-6


@pytest.mark.parametrize(
    "name", ["fast_muscle", "weld_sites", "pulley", "site", "sparse", "joint_force_limit", "fast_spinning_fluid"]
)
def test_both_tapes_agree_on_other_features(name):
    model = SCENES[name]()
    points = random_points(model, 3, seed=9)
    weights = random_weights(model, 3, 5)
    _, one, _ = simulate(model, TapePerSubstep(), points, 4, weights)
    _, other, _ = simulate(model, TapeAll(), points, 4, weights)
    for key in INPUTS:
        assert relative(one[key], other[key]) < 1e-6


def test_worlds_do_not_touch_each_other():
    model = ant("elliptic")
    points = ant_points(model, 4, seed=3)
    weights = random_weights(model, 4, 6)
    _, clean, _ = simulate(model, TapePerSubstep(), points, 4, weights)
    for w in weights.values():
        w[1] = 0.0
    points[2].qvel[:] = np.nan
    _, found, _ = simulate(model, TapePerSubstep(), points, 4, weights)
    for name in ("ctrl", "qpos", "qvel"):
        assert np.all(found[name][1] == 0.0)
        assert np.any(np.isnan(found[name][2]))
        for world in (0, 3):
            assert relative(found[name][world], clean[name][world]) < 1e-6


@pytest.mark.parametrize("integrator", [mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4])
def test_a_zero_cotangent_gives_zeros_even_in_a_diverged_world(integrator):
    model = cartpole()
    model.opt.integrator = integrator
    points = [float32(np.full(2, np.nan), np.zeros(2), np.zeros(0), np.zeros(1)) for _ in range(2)]
    weights = {n: np.zeros_like(w) for n, w in random_weights(model, 2, 0).items()}
    _, found, _ = simulate(model, TapePerSubstep(), points, 2, weights)
    assert all(np.all(found[n] == 0.0) for n in INPUTS)


def test_clip_keeps_direction_and_counts():
    model = cartpole()
    points = [float32(np.zeros(2), np.zeros(2), np.zeros(0), np.zeros(1)) for _ in range(2)]
    weights = random_weights(model, 2, 1)
    weights["qpos"][0] *= 1e-3
    weights["qvel"][0] *= 1e-3
    mode = TapePerSubstep(substep_grad_clip=0.5)
    _, found, sim = simulate(model, mode, points, 2, weights)
    _, free, _ = simulate(model, TapePerSubstep(), points, 2, weights)
    np.testing.assert_allclose(found["qvel"][0], free["qvel"][0], rtol=1e-6)
    assert relative(found["qvel"][1], free["qvel"][1]) > 1e-2
    assert sim.diagnostics()["substep_clip_share"] == 0.5


@pytest.mark.parametrize("integrator", [mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4])
def test_residual_is_reported(integrator):
    model = ant()
    model.opt.integrator = integrator
    points = ant_points(model, 3, seed=4)
    _, _, sim = simulate(model, TapePerSubstep(), points, 2, random_weights(model, 3, 2))
    figures = sim.diagnostics()
    assert 0.0 < figures["solver_residual_max"] < 1e-4
    assert figures["solver_unconverged_share"] == 0.0
    assert sim.diagnostics()["solver_residual_max"] == 0.0


@pytest.mark.parametrize(
    ("mode", "length", "tolerance"),
    [
        *((mode, length, 1e-4) for mode in ("tape_per_substep", "tape_all", "hybrid") for length in (0.5, 1.01, 1.3)),
        *(("fd_jacobian", length, 3e-2) for length in (0.5, 1.3)),
    ],
)
def test_quaternions_that_are_not_of_unit_length(mode: str, length: float, tolerance: float) -> None:
    """Gradients in raw qpos, free and ball joint, against central differences of C MuJoCo, which normalises them."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="3 3 1"/><body pos="0 0 .1"><freejoint/><geom size="0.11"/>
        <body pos="0.3 0 0.3"><joint type="ball" stiffness="3" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size="0.05"/></body></body></worldbody></mujoco>"""
    )
    model.opt.tolerance = 1e-12
    rng = np.random.default_rng(0)
    qpos = model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, 0.3 * rng.normal(size=model.nv), 1.0)
    qpos[2] = 0.1
    qpos[3:11] *= length
    start = float32(qpos, 0.3 * rng.normal(size=model.nv), np.zeros(0), np.zeros(0))
    weights = rng.normal(size=model.nq + model.nv)

    def score(moved: np.ndarray) -> float:
        data = rollout(model, Point(moved, start.qvel, start.act, start.ctrl), 2)
        return float(weights @ np.concatenate((data.qpos, data.qvel)))

    expected = np.array([score(start.qpos + e) - score(start.qpos - e) for e in 1e-6 * np.eye(model.nq)]) / 2e-6
    sim = Simulation(model, 1, 2, mode, tolerance=1e-9)
    inputs = [torch.tensor(v[None], dtype=torch.float32) for v in (start.ctrl, start.qpos, start.qvel, start.act)]
    inputs[1].requires_grad_()
    inputs[0].requires_grad_()
    end = sim.step(*inputs)
    (torch.cat((end.qpos, end.qvel), dim=1) @ torch.tensor(weights, dtype=torch.float32)).sum().backward()
    found = inputs[1].grad[0].numpy()
    assert relative(found[3:11], expected[3:11]) < tolerance
    assert relative(found, expected) < tolerance


def test_backward_through_two_env_steps():
    model = cartpole()
    sim = Simulation(model, 3, 4, TapePerSubstep(), "cpu", tolerance=1e-12)
    start = sim.initial_state()
    ctrl = torch.full((3, 1), 0.3, requires_grad=True)

    def loss(u: torch.Tensor) -> torch.Tensor:
        state = sim.step(u, *start)
        state = sim.step(0.5 * u, *state)
        return (state.qpos.square() + state.qvel).sum()

    (found,) = torch.autograd.grad(loss(ctrl), ctrl)
    with torch.no_grad():
        expected = (loss(ctrl + 1e-2) - loss(ctrl - 1e-2)) / 2e-2
    assert abs(float(found.sum() - expected)) < 1e-3 * abs(float(expected))


def test_unsupported_features_are_named():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><option integrator="implicit" noslip_iterations="1"/>
        <worldbody><body><joint name="j" type="slide"/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    with pytest.raises(UnsupportedModelError, match=r"IMPLICIT.*noslip.*fd_jacobian"):
        Simulation(model, 1, 1, TapePerSubstep(), "cpu")


def test_tape_all_refuses_rk4_and_names_the_other_tape():
    model = cartpole()
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    with pytest.raises(UnsupportedModelError, match=r"write physics\.backward=tape_per_substep"):
        Simulation(model, 1, 1, TapeAll(), "cpu")


def test_hybrid_takes_ctrl_from_one_mode_and_state_from_the_other():
    model = cartpole()
    points = [float32(np.full(2, 0.2), np.ones(2), np.zeros(0), np.full(1, 0.3)) for _ in range(2)]
    weights = random_weights(model, 2, 4)
    _, exact, _ = simulate(model, TapePerSubstep(), points, 4, weights)
    _, approximate, _ = simulate(model, FdJacobian(), points, 4, weights)
    _, mixed, _ = simulate(model, Hybrid(state=TapePerSubstep(), ctrl=FdJacobian()), points, 4, weights)
    np.testing.assert_allclose(mixed["qpos"], exact["qpos"])
    np.testing.assert_allclose(mixed["qvel"], exact["qvel"])
    np.testing.assert_allclose(mixed["ctrl"], approximate["ctrl"], rtol=1e-6)


def test_chain_through_a_policy_network():
    """Eight env steps of four substeps under a feedback policy, against differences of the whole loss in float64."""
    model = cartpole()
    torch.manual_seed(0)
    policy = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1), torch.nn.Tanh())
    sim = Simulation(model, 1, 4, TapePerSubstep(), "cpu", tolerance=1e-12)
    start = float32(np.array([0.1, 0.3]), np.array([0.2, -0.4]), np.zeros(0), np.zeros(1))

    def as_tensor(value: np.ndarray) -> torch.Tensor:
        return torch.tensor(value, dtype=torch.float32)[None]

    qpos, qvel, act = as_tensor(start.qpos), as_tensor(start.qvel), as_tensor(start.act)
    for _ in range(8):
        qpos, qvel, act = sim.step(policy(torch.cat((qpos, qvel), -1)), qpos, qvel, act)
    loss = (qpos.square() + 0.1 * qvel).sum()
    found = torch.cat([g.flatten() for g in torch.autograd.grad(loss, list(policy.parameters()))]).double().numpy()

    vector = torch.nn.utils.parameters_to_vector(policy.parameters()).double()
    policy.double()

    def loss_at(parameters: torch.Tensor) -> float:
        torch.nn.utils.vector_to_parameters(parameters, policy.parameters())
        point = start
        for _ in range(8):
            with torch.no_grad():
                ctrl = policy(torch.tensor(np.concatenate((point.qpos, point.qvel)))).numpy()
            data = rollout(model, Point(point.qpos, point.qvel, point.act, ctrl), 4)
            point = Point(data.qpos.copy(), data.qvel.copy(), data.act.copy(), ctrl)
        return float(np.sum(point.qpos**2 + 0.1 * point.qvel))

    steps = 1e-5 * torch.eye(len(vector), dtype=torch.float64)
    expected = np.array([(loss_at(vector + s) - loss_at(vector - s)) / 2e-5 for s in steps])
    assert relative(found, expected) < 1e-3
