"""Gradients of models that stop their solver early, and the reports of a solver that has not converged."""

import copy
import warnings

import mujoco
import numpy as np
import pytest
import torch
from oracle import INPUTS, Point, differences, relative, simulate, tighten
from scenes import ant, ant_points, random_weights

from msk_ray.algorithms.base import simulation_metrics
from msk_ray.config import parse_config
from msk_ray.envs.make import make_env
from msk_ray.step import Kernels, Simulation

UNCONVERGED = r"constraint solver stopped before it had converged in .*%.*raise physics\.iterations \(now 1\)"


def _hasty() -> mujoco.MjModel:
    """An ant in contact whose solver stops after one iteration, as in models made for MJX."""
    model = ant("elliptic")
    model.opt.iterations, model.opt.ls_iterations = 1, 5
    return model


def _backward(sim: Simulation, points: list[Point]) -> None:
    state = [torch.tensor(np.stack([getattr(p, n) for p in points]), dtype=torch.float32) for n in INPUTS[1:]]
    ctrl = torch.zeros((sim.nworld, sim.model.nu), requires_grad=True)
    sim.step(ctrl, *state).qvel.sum().backward()


@pytest.mark.filterwarnings("ignore:the model may stop the constraint solver")
@pytest.mark.parametrize("mode", ["tape_per_substep", "tape_all"])
def test_a_model_that_stops_its_solver_early_has_the_gradient_of_the_converged_step(mode: str) -> None:
    model = _hasty()
    points = ant_points(ant("elliptic"), 6, seed=1)
    weights = random_weights(model, len(points), 3)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="the constraint solver stopped")
        _, found, sim = simulate(model, mode, points, 2, weights)
    exact, errors = tighten(copy.copy(model)), []
    for i, point in enumerate(points):
        expected, kink = differences(exact, point, 2, {n: w[i] for n, w in weights.items()})
        if kink < 1e-2:
            errors += [relative(found[name][i], expected[name]) for name in INPUTS]
    assert len(errors) >= 4 * len(INPUTS)
    assert max(errors) < 1e-3
    assert sim.diagnostics()["solver_unconverged_substeps"] == 0.0


@pytest.mark.parametrize("mode", ["tape_per_substep", "tape_all", "hybrid"])
def test_a_solver_that_has_not_converged_is_reported_once(mode: str) -> None:
    model = _hasty()
    points = ant_points(ant("elliptic"), 4, seed=1)
    sim = Simulation(model, len(points), 2, mode, kernels=Kernels(iterations=1, ls_iterations=5))
    with pytest.warns(UserWarning, match=UNCONVERGED):
        _backward(sim, points)
    share = sim.diagnostics()["solver_unconverged_substeps"]
    assert 0.1 < share <= 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _backward(sim, points)
        assert sim.diagnostics()["solver_unconverged_substeps"] == share
        assert sim.diagnostics()["solver_unconverged_substeps"] == 0.0


def test_linearize_reports_it_too() -> None:
    points = ant_points(ant("elliptic"), 2, seed=1)
    sim = Simulation(_hasty(), len(points), 2, kernels=Kernels(iterations=1, ls_iterations=5))
    inputs = [torch.tensor(np.stack([getattr(p, n) for p in points]), dtype=torch.float32) for n in INPUTS]
    with pytest.warns(UserWarning, match=UNCONVERGED):
        sim.linearize(*inputs)


def test_a_share_below_the_bound_is_no_warning_and_a_diverged_world_no_matter_of_the_solver() -> None:
    points = ant_points(ant("elliptic"), 2, seed=1)
    points[1].qvel[:] = np.nan
    sim = Simulation(ant("elliptic"), len(points), 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _backward(sim, points)
        figures = sim.diagnostics()
    assert figures["solver_unconverged_substeps"] == 0.0
    assert np.isnan(figures["solver_residual_max"])


def test_training_reports_it_as_a_metric_and_a_warning() -> None:
    """Settings of a config are kept, however low; without them, the environment's model is solved to the end."""
    config = parse_config({"env": {"name": "ant"}, "physics": {"iterations": 1, "ls_iterations": 5}})
    env = make_env(config.env, config.physics, 2, "cpu", 0)
    assert env.sim.batch.limits == (1, 5)
    state = env.draw_physics(2)
    state.qpos[:, 2] -= 0.5
    env.sim.step(torch.zeros((2, env.model.nu), requires_grad=True), *state)
    with pytest.warns(UserWarning, match=UNCONVERGED):
        figures = simulation_metrics(env)
    assert figures["physics/solver_unconverged_substeps"] > 0.1
