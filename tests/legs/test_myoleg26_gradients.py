"""The 26-muscle model against C MuJoCo in float64: the step, its gradient, and that through eight control steps."""

import mujoco
import numpy as np
import pytest
import torch
from policy_gradient import check_chain
from slopes import check_slopes

from msk_ray.config import PhysicsConfig
from msk_ray.envs import make_env
from msk_ray.legs.config import LegReward
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.model import SUBSTEPS, build_myoleg26
from msk_ray.step import Simulation, TapePerSubstep
from msk_ray.step.check import check_gradients, make_states

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_myoleg26(MyoLeg26Settings(name="myoleg26"), PhysicsConfig())


@pytest.mark.parametrize("substeps", [1, 8])
def test_gradients_of_a_step(model: mujoco.MjModel, substeps: int) -> None:
    kinds = ("standing", "contact", "policy") if substeps == 1 else ("standing", "contact")
    report = check_gradients(Simulation(model, 2, substeps, tolerance=1e-9), states=kinds)
    assert report.checked >= 3
    assert {r.input for r in report.results} == {"ctrl", "qpos", "qvel", "act"}
    assert report.max_rel_error <= 1e-3


def test_gradients_through_eight_control_steps(model: mujoco.MjModel) -> None:
    points = make_states(model, "policy", 2, 0)
    for result in check_chain(model, TapePerSubstep(), points, (8,), substeps=SUBSTEPS):
        assert result.rel_error <= 1e-3


@pytest.mark.parametrize("name", ["stand", "walk_left", "walk_right"])
def test_forward_agrees_with_c_mujoco_over_100_steps(model: mujoco.MjModel, name: str) -> None:
    sim = Simulation(model, 1, 1, None, "cpu", tolerance=1e-9)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(name).id)
    data.ctrl[:] = 0.1
    state = [torch.tensor(part[None], dtype=torch.float32) for part in (data.qpos, data.qvel, data.act)]
    ctrl = torch.full((1, model.nu), 0.1)
    for _ in range(100):
        mujoco.mj_step(model, data)
        state = sim.step(ctrl, *state)
    for found, exact in zip(state, (data.qpos, data.qvel, data.act), strict=True):
        assert np.linalg.norm(found[0].numpy() - exact) <= 1e-3 * np.linalg.norm(exact)


def test_reward_and_observation_have_the_gradient_of_their_own_values() -> None:
    """Through muscle lengths, rates and forces, joint limits and the pelvis, by central differences of the value."""
    config = MyoLeg26Settings(
        name="myoleg26", reward=LegReward(symmetry=0.3, stride=0.4, progress=0.2), stochastic_reset=False
    )
    env = make_env(config, PhysicsConfig(), 1, "cpu", 0, differentiable=False)
    rng = np.random.default_rng(3)
    parts = [part[0].numpy().astype(float) for part in env.state.physics]
    parts[0][3:] += 0.1 * rng.normal(size=15)
    parts[1] += 0.5 * rng.normal(size=18)
    parts[2][:] = rng.uniform(0.1, 0.9, size=26)
    action = torch.tensor(rng.uniform(-0.9, 0.9, size=(1, 26)), dtype=torch.float32)
    weights = torch.tensor(rng.normal(size=env.obs_size), dtype=torch.float32)

    def value(arrays: list[torch.Tensor]) -> torch.Tensor:
        state = type(env.state.physics)(*arrays)
        obs = env.observe(state, action)
        return (obs * weights).sum() + 10.0 * env.reward_terms(state, action, obs).sum()

    check_slopes(value, parts, rng, step=2e-3, rel=5e-3, abs=5e-3, free=False)


def test_activation_carries_most_of_the_gradient_across_control_steps() -> None:
    """Fault: an activation that is cut between control steps loses most of what an excitation does later."""
    config = MyoLeg26Settings(name="myoleg26", stochastic_reset=False)
    env = make_env(config, PhysicsConfig(), 1, "cpu", 0)
    norms = []
    for cut in (False, True):
        env.state = env.reset_state()
        first = torch.zeros((1, 26), requires_grad=True)
        env.step(first, auto_reset=False)
        if cut:
            physics = env.state.physics
            env.state = env.state._replace(physics=physics._replace(act=physics.act.detach()))
        env.step(torch.zeros((1, 26)), auto_reset=False)
        (gradient,) = torch.autograd.grad(env.state.physics.qvel.square().sum(), first)
        norms.append(float(gradient.norm()))
    assert norms[1] < 0.7 * norms[0]
