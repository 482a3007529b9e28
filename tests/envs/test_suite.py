"""Hopper, cheetah and humanoid: documented numbers, dflex's springs in MuJoCo's terms, falls, gradients."""

import math
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.config import parse_config
from msk_ray.envs import Env, env_class, make_env
from msk_ray.step import Simulation, StepState, check_gradients
from msk_ray.step.check.check import compare
from msk_ray.step.check.oracle import Oracle, Point
from msk_ray.step.check.pullback import simulated_gradients

SIZES = {"hopper": (6, 6, 3, 4), "cheetah": (9, 9, 6, 8), "humanoid": (28, 27, 21, 19)}
"""nq, nv, nu and pairs with the floor."""
GROUND = {
    "ant": (4e4, 1e4, 3e3, 0.75),
    "hopper": (2e4, 1e3, 1e3, 0.9),
    "cheetah": (2e4, 1e3, 1e3, 1.0),
    "humanoid": (2e4, 5e3, 1e3, 0.75),
}
"""dflex's contact: stiffness [N/m], damping per depth [N s/m²], friction damping [N s/m], friction coefficient
(envs/*.py of NVlabs/DiffRL)."""


def model_of(name: str, **physics: Any) -> mujoco.MjModel:
    config = parse_config({"env": {"name": name}, "physics": physics})
    return env_class(config.env).build_model(config.env, config.physics)


def on_springs(name: str) -> mujoco.MjModel:
    """The body on contacts made of dflex's springs."""
    return model_of(name, variant="matched_springs" if name == "ant" else "matched")


@cache
def env_of(name: str) -> Env:
    config = parse_config({"env": {"name": name}})
    return make_env(config.env, config.physics, 2, "cpu", 0, differentiable=False)


def state_of(qpos: list[float] | torch.Tensor, qvel: list[float] | torch.Tensor) -> StepState:
    return StepState(torch.as_tensor(qpos)[None], torch.as_tensor(qvel)[None], torch.zeros(1, 0))


def terms_of(env: Env, state: StepState, action: torch.Tensor) -> dict[str, float]:
    terms = env.reward_terms(state, action, env.observe(state, action))[0]
    return dict(zip(env.reward_names, terms.tolist(), strict=True))


def test_hopper_by_hand() -> None:
    env = env_of("hopper")
    action = torch.tensor([[0.5, -1.0, 0.0]])
    state = state_of([7.0, -0.1, 0.2, -0.3, -0.4, 0.5], [1.5, 2.0, 3.0, 4.0, 5.0, 6.0])
    expected = [-0.1, 0.2, -0.3, -0.4, 0.5, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert env.observe(state, action)[0].tolist() == pytest.approx(expected)
    # 0.2 m above −0.3 m; 1 − (0.2 / (π/6))²; −0.1 (0.25 + 1)
    upright = 1.0 - 0.04 / (math.pi**2 / 36)
    values = {"forward_vel": 1.5, "height": 0.2, "upright": upright, "action": -0.125}
    assert terms_of(env, state, action) == pytest.approx(values)
    heights = {0.3: 0.3, -0.4: -200 * 0.01, -9.0: -200.0}  # full; 0.1 m too low; far below
    for height, term in heights.items():
        state.qpos[0, 1] = height
        assert terms_of(env, state, action)["height"] == pytest.approx(term, rel=1e-5)


def test_cheetah_by_hand() -> None:
    env = env_of("cheetah")
    action = torch.tensor([[1.0, 0.0, 0.0, 0.0, -0.5, 0.0]])
    state = state_of(torch.arange(9.0), 10.0 + torch.arange(9.0))
    assert env.observe(state, action)[0].tolist() == [*range(1, 9), *range(10, 19)]
    assert terms_of(env, state, action) == pytest.approx({"forward_vel": 10.0, "action": -0.125})


def test_humanoid_by_hand() -> None:
    env = env_of("humanoid")
    # yaw by 0.4 rad, at (200 m, 50 m): the target is straight to the right
    turn = torch.tensor([math.cos(0.2), 0.0, 0.0, math.sin(0.2)])
    qpos = torch.cat((torch.tensor([200.0, 50.0, 0.9]), turn, torch.arange(21.0)))
    qvel = torch.arange(27.0)
    action = torch.linspace(-1, 1, 21)[None]
    state = state_of(qpos, qvel)
    obs = env.observe(state, action)[0]
    assert obs.shape == (76,)
    assert torch.equal(obs[:5], qpos[2:7])
    assert torch.equal(obs[5:8], qvel[:3])
    c, s = math.cos(0.4), math.sin(0.4)
    assert obs[8:11].tolist() == pytest.approx([3 * c - 4 * s, 3 * s + 4 * c, 5.0], rel=1e-5)
    assert torch.equal(obs[11:32], qpos[7:])
    assert torch.allclose(obs[32:53], 0.1 * qvel[6:])
    assert obs[53:55].tolist() == pytest.approx([1.0, -s], abs=1e-6)
    assert torch.equal(obs[55:], action[0])
    square = sum((-1 + k / 10) ** 2 for k in range(21))
    values = {"forward_vel": 0.0, "up": 0.1, "heading": -s, "height": 0.6, "action": -0.002 * square}
    assert terms_of(env, state, action) == pytest.approx(values, rel=1e-4, abs=1e-6)
    state.qpos[0, 2:7] = torch.tensor([0.8, math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0])  # on its side, 4 cm too low
    assert terms_of(env, state, action)["up"] == pytest.approx(0.0, abs=1e-6)
    assert terms_of(env, state, action)["height"] == pytest.approx(-200 * 0.04**2, rel=1e-4)


@pytest.mark.parametrize(("name", "at", "lowest"), [("hopper", 1, -0.45), ("humanoid", 2, 0.74), ("cheetah", 1, None)])
def test_only_a_body_below_its_height_has_fallen(name: str, at: int, lowest: float | None) -> None:
    env = env_of(name)
    state = env.draw_physics(2)
    assert not env.fell(state).any()
    state.qpos[:, at] = torch.tensor([-5.0, -5.0] if lowest is None else [lowest - 0.01, lowest + 0.01])
    assert env.fell(state).tolist() == [lowest is not None, False]


@pytest.mark.parametrize("variant", ["matched", "published"])
@pytest.mark.parametrize("name", sorted(SIZES))
def test_layout(name: str, variant: str) -> None:
    model = model_of(name, variant=variant)
    assert (model.nq, model.nv, model.nu, model.npair) == SIZES[name]
    assert model.opt.timestep == pytest.approx(1 / 240)
    # Motors drive the hinges in their order.
    assert model.actuator_trnid[:, 0].tolist() == list(range(model.njnt - model.nu, model.njnt))


def test_measures_of_the_sources() -> None:
    """Masses by hand: π r² l + 4/3 π r³ times the density; torques, dampers and armatures as in DiffRL's files."""
    capsule = lambda r, length: 1e3 * math.pi * r * r * (length + 4 * r / 3)  # noqa: E731
    hopper, cheetah, humanoid = (model_of(name) for name in ("hopper", "cheetah", "humanoid"))
    assert hopper.body("foot").mass[0] == pytest.approx(capsule(0.06, 0.39))
    assert hopper.dof_damping.tolist() == [10, 10, 10, 12, 12, 12]
    assert hopper.dof_armature.tolist() == [1.0] * 6
    assert cheetah.body("hind_shin").mass[0] == pytest.approx(capsule(0.046, 0.3))
    assert cheetah.dof_damping.tolist() == [10, 10, 10, 16, 14.5, 13, 14.5, 13, 11.5]
    assert cheetah.jnt_range[-1].tolist() == [-3.1, -0.3]
    assert set(hopper.actuator_gear[:, 0]) == set(cheetah.actuator_gear[:, 0]) == {200.0}
    assert humanoid.body("right_shin").mass[0] == pytest.approx(capsule(0.049, 0.3))
    leg = [70.0, 70.0, 210.0, 140.0, 35.0, 35.0]
    arm = [35.0, 35.0, 70.0]
    assert humanoid.actuator_gear[:, 0].tolist() == pytest.approx([70.0] * 3 + leg * 2 + arm * 2)
    assert humanoid.joint("left_knee").damping[0] == pytest.approx(10.1)
    assert model_of("cheetah", variant="published").body_mass.sum() == pytest.approx(14.0)
    assert model_of("humanoid", variant="published").actuator_gear[3:9, 0].tolist() == [45, 45, 135, 90, 22.5, 22.5]


@pytest.mark.parametrize("name", sorted(GROUND))
def test_a_foot_pressed_into_the_floor_is_pushed_as_in_dflex(name: str) -> None:
    """D (d k c − b v): k_e·c and −k_d·(1 cm)·v up, −k_f·v along the floor, and 1000 N m/rad from a limit."""
    stiffness, damping, viscosity, friction = GROUND[name]
    model = on_springs(name)
    assert set(model.pair_friction[:, 0]) == {friction}
    data = pressed(model, 0.005)
    data.qvel[0] = 0.02
    data.qvel[2 if model.nq > model.nv else 1] = -0.5
    mujoco.mj_forward(model, data)
    force = data.efc_D * data.efc_aref
    assert data.ncon >= 1
    for contact in data.contact:
        row = contact.efc_address
        assert force[row] == pytest.approx(-stiffness * contact.dist + 0.01 * damping * 0.5, rel=1e-6)
        along = contact.frame.reshape(3, 3)[1:, 0]
        assert force[row + 1 : row + 3] == pytest.approx(-viscosity * 0.02 * along, abs=1e-6)
    last = model.njnt - 1
    data.qvel[:] = 0.0
    data.qpos[model.jnt_qposadr[last]] = model.jnt_range[last, 1] + 0.1
    mujoco.mj_forward(model, data)
    limits = np.flatnonzero(data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)
    (row,) = [i for i in limits if data.efc_id[i] == last]
    assert data.efc_D[row] * data.efc_aref[row] == pytest.approx(100.0, rel=1e-6)


def pressed(model: mujoco.MjModel, depth: float) -> mujoco.MjData:
    """The body at rest with its feet flat and as deep in the floor as that [m]."""
    data = mujoco.MjData(model)
    if model.nkey:
        data.qpos[:] = model.key("stand").qpos
    if model.nv == 6:
        data.qpos[3:] = (-0.2, -0.4, 0.6)  # away from the ends of the ranges
    mujoco.mj_forward(model, data)
    floor = model.geom("floor").id
    geoms = [geom for geom in range(model.ngeom) if geom != floor]
    lowest = min(mujoco.mj_geomDistance(model, data, floor, geom, 9.0, None) for geom in geoms)
    data.qpos[2 if model.nq > model.nv else 1] -= lowest + depth
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("name", sorted(GROUND))
def test_gradients_of_a_step(name: str) -> None:
    """Against float64 central differences: standing symmetrically, sliding, and moving in contact."""
    model = on_springs(name)
    sim = Simulation(model, 2, 4, tolerance=1e-9)
    qpos = pressed(model, 0.004).qpos.astype(np.float32).astype(np.float64)
    ctrl = np.linspace(-0.3, 0.4, model.nu).astype(np.float32).astype(np.float64)
    slow, none = np.zeros(model.nv), np.zeros(0)
    slow[0] = 0.25
    points = [Point(ctrl=ctrl, qpos=qpos, qvel=speed, act=none) for speed in (np.zeros(model.nv), slow)]
    cotangents = np.random.default_rng(0).standard_normal((2, 2 * model.nv)).astype(np.float32).astype(np.float64)
    oracle = Oracle(model, 4)
    assert all(oracle.touching(point) for point in points)
    _, gradients = simulated_gradients(sim, points, cotangents, ())
    for world, point in enumerate(points):
        reference = oracle.linearize(point)
        assert not reference.at_kink(1e-3, 1e-2)
        for key, expected in reference.pull_back(cotangents[world]).items():
            if expected.size:
                error, *_ = compare(gradients[key][world], expected, float(np.linalg.norm(cotangents[world])))
                assert error < 1e-3, (world, key)
    report = check_gradients(sim, states=("contact",))
    assert report.checked >= 1
    assert report.max_rel_error < 2e-3
