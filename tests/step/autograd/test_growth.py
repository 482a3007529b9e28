"""A step that needs more room than there is: repeated with more, or an error, and never a wrong state."""

import numpy as np
import pytest
import torch
from oracle import INPUTS, Point, differences, relative, rollout, simulate
from scenes import random_weights, studded_plate

from msk_ray.errors import SimulationError
from msk_ray.step import FdJacobian, Simulation
from msk_ray.step.autograd.backward import Backward
from msk_ray.step.autograd.hybrid import Hybrid
from msk_ray.step.autograd.tape import TapeAll, TapePerSubstep
from msk_ray.step.forward import capacity
from msk_ray.step.forward.capacity import Capacity

MODES = {
    "tape_per_substep": TapePerSubstep,
    "tape_all": TapeAll,
    "fd_jacobian": FdJacobian,
    "hybrid": lambda: Hybrid(TapePerSubstep(), FdJacobian()),
}


@pytest.fixture
def shy_probe(monkeypatch):
    """A probe that saw nothing touch: what is allocated is the least."""
    monkeypatch.setattr(capacity, "probe", lambda model: Capacity(0, 0))


def falling(model, worlds: int) -> dict[str, torch.Tensor]:
    """Plates a little above the ground and moving down, no two alike."""
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (worlds, 1))
    qpos[:, 2] = 0.0505
    qvel = 0.02 * rng.normal(size=(worlds, model.nv)) - np.array([0, 0, 0.3, 0, 0, 0])
    ctrl = rng.uniform(-1, 1, size=(worlds, model.nu))
    values = {"ctrl": ctrl, "qpos": qpos, "qvel": qvel, "act": np.zeros((worlds, 0))}
    return {n: torch.tensor(v, dtype=torch.float32, requires_grad=True) for n, v in values.items()}


def test_states_and_gradients_of_a_model_whose_bound_is_large():
    """With mujoco_warp's own guess of 64 rows, velocity and gradients are wrong where the plate lies on 256."""
    model = studded_plate()
    points = []
    for k, depth in enumerate((0.049, 0.0494)):
        qpos = model.qpos0.copy()
        qpos[2] = depth
        qpos, qvel = (v.astype(np.float32).astype(float) for v in (qpos, np.full(6, 0.01 * k)))
        points.append(Point(qpos, qvel, np.zeros(0), np.full(1, 0.5)))
    weights = random_weights(model, 2, 1)
    end, found, _ = simulate(model, TapePerSubstep(), points, 2, weights)
    for i, point in enumerate(points):
        np.testing.assert_allclose(end.qvel[i].detach(), rollout(model, point, 2).qvel, atol=1e-4)
        expected, kink = differences(model, point, 2, {n: w[i] for n, w in weights.items()})
        assert kink < 1e-2
        for name in INPUTS:
            assert relative(found[name][i], expected[name]) < 1e-3


@pytest.mark.parametrize("name", MODES)
@pytest.mark.usefixtures("shy_probe")
def test_a_step_is_repeated_with_more_room(name):
    """The second of three steps lands; each is pulled back with the buffers that it was made with."""
    model = studded_plate()

    def gradients(mode: Backward, **sizes: Capacity) -> tuple[list[np.ndarray], Simulation]:
        sim = Simulation(model, 2, 2, mode, "cpu", tolerance=1e-12, **sizes)
        inputs = falling(model, 2)
        state = (inputs["qpos"], inputs["qvel"], inputs["act"])
        for _ in range(3):
            state = sim.step(inputs["ctrl"], *state)
        loss = (state[1] * torch.arange(1.0, 7.0)).sum() + state[0][:, :3].sum()
        wanted = [inputs[n] for n in ("ctrl", "qpos", "qvel")]
        return [g.numpy() for g in (*torch.autograd.grad(loss, wanted), state[0].detach(), state[1].detach())], sim

    expected, roomy = gradients(MODES[name](), capacity=Capacity(320, 1280))
    assert roomy.capacity == (320, 1280)
    found, grown = gradients(MODES[name]())
    assert grown.capacity.rows >= 256
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
    grown.diagnostics()


@pytest.mark.parametrize("name", ["tape_per_substep", "fd_jacobian"])
def test_given_sizes_that_are_too_small_are_an_error_at_the_step(name):
    model = studded_plate()
    sim = Simulation(model, 2, 4, MODES[name](), "cpu", capacity=Capacity(48, 64))
    state = sim.initial_state()
    ctrl = torch.zeros(2, model.nu)
    while float(state.qpos[0, 2]) > 0.15:
        state = sim.step(ctrl, *state)
        assert all(torch.isfinite(value).all() for value in state)
    lying = state.qpos.clone()
    lying[:, 2] = 0.049
    with pytest.raises(SimulationError, match=r"execution\.njmax: \d+ \(now 64 ") as caught:
        sim.step(ctrl, lying, state.qvel, state.act)
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("shy_probe")
def test_buffers_that_are_nearly_full_grow_between_epochs():
    model = studded_plate()
    sim = Simulation(model, 1, 1, None, "cpu")
    sim.reserve(Capacity(65, 257))
    inputs = {n: v.detach() for n, v in falling(model, 1).items()}
    inputs["qpos"][:, 2] = 0.049
    sim.step(**inputs)
    figures = sim.diagnostics()
    assert figures["contacts_share"] == pytest.approx(64 / 65)
    assert figures["rows_share"] == pytest.approx(256 / 257)
    assert sim.capacity == (130, 514)
    assert sim.diagnostics()["rows_share"] == 0.0
    assert sim.capacity == (130, 514)


def test_reserve_leaves_given_sizes_alone():
    sim = Simulation(studded_plate(), 1, 1, None, "cpu", capacity=Capacity(rows=100))
    sim.reserve(Capacity(10**6, 10**6))
    assert sim.capacity == (320, 100)
