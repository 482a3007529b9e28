"""Gradients to qfrc_applied and xfrc_applied, and of everything else under them, against C MuJoCo in float64."""

from dataclasses import dataclass, field

import mujoco
import numpy as np
import pytest
import torch
from oracle import INPUTS, Point, relative, shifted
from scenes import ant, ant_points, cartpole, random_weights

from msk_ray.errors import ConfigError, UnsupportedModelError
from msk_ray.step import FdJacobian, Hybrid, Simulation, TapeAll, TapePerSubstep

FORCES = ("qfrc_applied", "xfrc_applied")


@dataclass
class Pushed:
    """A point under applied forces, float64."""

    point: Point
    qfrc_applied: np.ndarray
    xfrc_applied: np.ndarray = field(repr=False)


def pushed(model: mujoco.MjModel, points: list[Point], size: float) -> list[Pushed]:
    rng = np.random.default_rng(5)
    rounded = lambda *shape: (size * rng.normal(size=shape)).astype(np.float32).astype(float)  # noqa: E731
    return [Pushed(p, rounded(model.nv), rounded(model.nbody, 6)) for p in points]


def end_of(model: mujoco.MjModel, at: Pushed, substeps: int) -> mujoco.MjData:
    data = mujoco.MjData(model)
    for name in INPUTS:
        getattr(data, name)[:] = getattr(at.point, name)
    data.qfrc_applied[:], data.xfrc_applied[:] = at.qfrc_applied, at.xfrc_applied
    for _ in range(substeps):
        mujoco.mj_step(model, data)
    return data


def slope(model: mujoco.MjModel, at: Pushed, substeps: int, weights: dict, name: str, direction: np.ndarray) -> float:
    """Central difference of ⟨weights, end⟩ along a direction of one input."""
    eps = 1e-3 if name in FORCES else 1e-6

    def moved(sign: float) -> Pushed:
        if name in FORCES:
            changed = getattr(at, name) + sign * eps * direction.reshape(getattr(at, name).shape)
            return Pushed(at.point, **({n: getattr(at, n) for n in FORCES} | {name: changed}))
        point = at.point
        for i, amount in enumerate(direction):
            point = shifted(model, point, name, i, sign * eps * amount)
        return Pushed(point, at.qfrc_applied, at.xfrc_applied)

    plus, minus = (end_of(model, moved(sign), substeps) for sign in (1.0, -1.0))
    change = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, change, 1.0, minus.qpos, plus.qpos)
    total = change @ weights["qpos"] + (plus.qvel - minus.qvel) @ weights["qvel"]
    return float(total + (plus.act - minus.act) @ weights["act"]) / (2.0 * eps)


def gradients(model, mode, places: list[Pushed], substeps: int, weights: dict) -> tuple[dict, Simulation]:
    sim = Simulation(model, len(places), substeps, mode, "cpu", tolerance=1e-12)
    of = {n: [getattr(p.point, n) for p in places] for n in INPUTS} | {
        n: [getattr(p, n) for p in places] for n in FORCES
    }
    inputs = {n: torch.tensor(np.stack(v), dtype=torch.float32, requires_grad=True) for n, v in of.items()}
    end = sim.step(*(inputs[n] for n in INPUTS), **{n: inputs[n] for n in FORCES})
    cotangent = {n: torch.tensor(w, dtype=torch.float32) for n, w in weights.items()}
    loss = (end.qvel * cotangent["qvel"]).sum() + (end.act * cotangent["act"]).sum()
    loss = loss + (end.qpos * sim.tangent.lift(end.qpos.detach(), cotangent["qpos"])).sum()
    found = dict(zip(inputs, torch.autograd.grad(loss, list(inputs.values())), strict=True))
    found["qpos"] = sim.tangent.project(inputs["qpos"].detach(), found["qpos"])
    return {n: g.numpy().astype(float) for n, g in found.items()}, sim


@pytest.mark.parametrize("substeps", [1, 4])
def test_an_ant_in_contact_under_forces(substeps):
    model = ant("elliptic")
    places = pushed(model, ant_points(model, 4, seed=2), 20.0)
    weights = random_weights(model, 4, 3)
    found, sim = gradients(model, TapePerSubstep(), places, substeps, weights)
    assert sim.diagnostics()["solver_residual_max"] < 1e-4
    rng = np.random.default_rng(1)
    for i, at in enumerate(places):
        mine = {n: w[i] for n, w in weights.items()}
        for name in ("ctrl", "qpos", "qvel", *FORCES):
            directions = [rng.normal(size=found[name][i].size) for _ in range(3)]
            expected = np.array([slope(model, at, substeps, mine, name, d) for d in directions])
            assert relative(np.array([found[name][i].ravel() @ d for d in directions]), expected) < 2e-3, (i, name)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_every_entry_of_the_forces_on_a_tilted_chain(integrator):
    """Without contacts, so that each of the forces' gradients can be held to 1e-5."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep=".004" integrator="{integrator}"/><worldbody><body pos="0 0 1" quat=".9 .1 .3 .2">
        <joint type="ball" damping=".1"/><geom type="capsule" size=".05" fromto="0 0 0 .4 .1 0"/>
        <body pos=".4 .1 0"><joint axis="0 1 1"/><geom type="box" size=".1 .05 .02" pos=".1 0 .05"/></body>
        </body></worldbody></mujoco>"""
    )
    point = Point(model.qpos0.copy(), np.array([0.3, -0.5, 0.2, 1.0]), np.zeros(0), np.zeros(0))
    (at,) = pushed(model, [point], 2.0)
    weights = random_weights(model, 1, 4)
    mode = TapePerSubstep() if integrator == "RK4" else TapeAll()
    found, _ = gradients(model, mode, [at], 4, weights)
    mine = {n: w[0] for n, w in weights.items()}
    for name in ("qpos", "qvel", *FORCES):
        expected = [slope(model, at, 4, mine, name, unit) for unit in np.eye(found[name][0].size)]
        assert relative(found[name][0].ravel(), np.array(expected)) < 1e-4, name
    approximate, _ = gradients(model, FdJacobian(), [at], 4, weights)
    for name in FORCES:
        assert relative(approximate[name], found[name]) < 1e-2, name


def test_forces_end_with_their_step():
    sim = Simulation(cartpole(), 2, 4, TapePerSubstep(), "cpu")
    start, ctrl = sim.initial_state(), torch.zeros(2, 1)
    plain = sim.step(ctrl, *start)
    force = torch.tensor([[1.0, 0.0], [0.0, 0.0]], requires_grad=True)
    driven = sim.step(ctrl, *start, qfrc_applied=force)
    assert driven.qvel[0, 0] > plain.qvel[0, 0]
    torch.testing.assert_close(driven.qvel[1], plain.qvel[1])
    torch.testing.assert_close(sim.step(ctrl, *start).qvel, plain.qvel, rtol=0, atol=0)
    driven.qvel.sum().backward()
    assert force.grad is not None
    torch.testing.assert_close(sim.step(ctrl, *start).qvel, plain.qvel, rtol=0, atol=0)


def test_steps_with_and_without_forces_are_pulled_back_in_one_pass():
    """With the state's gradient from one mode and the control's from another, which record different tensors."""
    gradients = []
    for mode in (TapePerSubstep(), Hybrid(TapePerSubstep(), FdJacobian())):
        sim = Simulation(cartpole(), 2, 4, mode, "cpu")
        ctrl, force = (torch.full((2, n), 0.5, requires_grad=True) for n in (1, 2))
        between = sim.step(ctrl, *sim.initial_state(), qfrc_applied=force)
        end = sim.step(ctrl, *between)
        gradients.append(torch.autograd.grad(end.qvel.square().sum(), (ctrl, force)))
    for one, other in zip(*gradients, strict=True):
        assert one.abs().min() > 1e-4
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)


def test_a_step_is_linearized_under_its_forces():
    """A force that follows the pole's hinge turns its balance into another one."""
    sim = Simulation(cartpole(), 1, 4, TapePerSubstep(), "cpu")
    start, ctrl = sim.initial_state(), torch.zeros(1, 1)
    push = torch.zeros(1, 3, 6)
    push[..., 2, 2] = -20.0  # down on the pole: it falls faster
    a = sim.linearize(ctrl, *start).A
    pushed_a = sim.linearize(ctrl, *start, xfrc_applied=push).A
    assert pushed_a[0, 3, 1] > a[0, 3, 1] + 0.1
    again = sim.linearize(ctrl, *start).A
    torch.testing.assert_close(again, a, rtol=0, atol=0)


def test_wrong_shapes_and_modes_that_cannot_are_refused():
    class Plain(TapePerSubstep):
        covers_applied = False

    sim = Simulation(cartpole(), 2, 1, Plain(), "cpu")
    start, ctrl = sim.initial_state(), torch.zeros(2, 1, requires_grad=True)
    with pytest.raises(ConfigError, match=r"xfrc_applied has shape \(2, 6\).*\(2, 3, 6\)"):
        sim.step(ctrl, *start, xfrc_applied=torch.zeros(2, 6))
    with pytest.raises(UnsupportedModelError, match="does not differentiate steps with applied forces"):
        sim.step(ctrl, *start, qfrc_applied=torch.zeros(2, 2))
    with torch.no_grad():
        sim.step(ctrl, *start, qfrc_applied=torch.zeros(2, 2))
