"""Gymnasium's interfaces: its own checks, the same physics and rewards, and an algorithm from elsewhere that learns."""

import copy
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from scenes import ant, ant_points
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

import msk_ray.gym
from msk_ray.config import Config, load_config, overlay, parse_config
from msk_ray.envs import make_env
from msk_ray.errors import ConfigError, SimulationError
from msk_ray.gym import BatchedEnv, SingleEnv
from msk_ray.gym.c_simulation import CSimulation
from msk_ray.gym.stable_baselines import StableBaselinesEnv
from msk_ray.step.forward.contact_watch import ContactQuery
from msk_ray.step.forward.solver_limits import SolverLimits

pytestmark = pytest.mark.long


def _cartpole(**changes: Any) -> Config:
    return parse_config(overlay(load_config("cartpole").as_dict(), changes))


@pytest.fixture(scope="module")
def batched() -> BatchedEnv[np.ndarray]:
    """Four carts whose episodes last three steps."""
    return BatchedEnv(_cartpole(**{"env.episode_length": 3}), 4)


@pytest.fixture
def single() -> SingleEnv:
    return SingleEnv(_cartpole(**{"env.episode_length": 3}))


@pytest.mark.filterwarnings("ignore:.*A Box observation space", "ignore:.*not having a spec")
def test_gymnasium_checks_a_single_environment() -> None:
    check_env(SingleEnv("cartpole"))


def test_the_last_observation_of_an_episode_is_kept_beside_the_first_of_the_next(
    batched: BatchedEnv[np.ndarray],
) -> None:
    assert batched.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    first, _ = batched.reset(seed=3)
    assert first in batched.observation_space
    action = np.full((4, 1), 0.5, np.float32)
    for step in range(1, 4):
        obs, reward, terminated, truncated, infos = batched.step(action)
        assert reward.shape == (4,)
        assert not terminated.any()
        assert truncated.all() == (step == 3)
        assert np.array_equal(infos["_final_obs"], truncated)
        # Until its end, the state goes on; then it is drawn anew.
        assert np.array_equal(infos["final_obs"], obs) == (step < 3)
    assert obs in batched.observation_space
    assert np.abs(obs[:, 1]).max() <= 0.25  # the speed of a cart that starts
    assert np.array_equal(batched.reset(seed=3)[0], first)
    assert not np.array_equal(batched.reset()[0], first)


def test_a_seed_draws_states_and_parameters_that_tell_nothing_of_each_other() -> None:
    changes = {"physics.randomize": {"body_mass": {"low": 0.5, "high": 1.5}}, "trial.seed": 3}
    env = BatchedEnv(_cartpole(**changes), 4).env
    first = env.state
    again = BatchedEnv(_cartpole(**changes | {"trial.seed": 4}), 4)
    again.reset(seed=3)
    assert torch.equal(again.env.state.physics.qpos, first.physics.qpos)
    assert torch.equal(again.env.state.numbers, first.numbers), "as in a trial of this seed"


def test_tensors_and_arrays_say_the_same(batched: BatchedEnv[np.ndarray]) -> None:
    tensors: BatchedEnv[torch.Tensor] = BatchedEnv(_cartpole(**{"env.episode_length": 3}), 4, arrays="torch")
    obs, _ = batched.reset(seed=5)
    assert np.array_equal(tensors.reset(seed=5)[0].numpy(), obs)
    action = np.linspace(-2.0, 1.0, 4, dtype=np.float32)[:, None]
    expected, stepped = batched.step(action), tensors.step(torch.from_numpy(action))
    for ours, theirs in zip(expected[:4], stepped[:4], strict=True):
        assert np.array_equal(ours, theirs.numpy())
    batched.reset(seed=5)
    assert np.array_equal(batched.step(action.clip(-1.0, 1.0))[0], expected[0]), "actions are clipped"


def test_what_is_returned_is_not_written_again(batched: BatchedEnv[np.ndarray]) -> None:
    obs, _ = batched.reset(seed=1)
    before = obs.copy()
    results = batched.step(np.ones((4, 1), np.float32))
    kept = [part.copy() for part in results[:4]]
    batched.step(np.ones((4, 1), np.float32))
    assert np.array_equal(obs, before)
    assert all(np.array_equal(now, then) for now, then in zip(results[:4], kept, strict=True))


def test_a_single_world_in_c_mujoco_does_what_the_batch_does(single: SingleEnv) -> None:
    one: BatchedEnv[np.ndarray] = BatchedEnv(_cartpole(**{"env.episode_length": 3}), 1)
    obs, _ = single.reset(seed=7)
    one.reset(seed=7)
    one.env.state = single.env.state
    assert np.array_equal(single.env.observation()[0].numpy(), obs)
    for step in range(1, 4):
        action = np.array([0.3 * step], np.float32)
        obs, reward, terminated, truncated, info = single.step(action)
        _, batch_reward, _, batch_truncated, infos = one.step(action[None])
        assert obs == pytest.approx(infos["final_obs"][0], abs=1e-4)
        assert reward == pytest.approx(float(batch_reward[0]), rel=1e-4)
        assert (terminated, truncated) == (False, bool(batch_truncated[0]))
        assert sum(info["terms"].values()) == pytest.approx(reward, rel=1e-5)
    assert truncated
    assert single.data.qpos[0] == pytest.approx(obs[0], abs=1e-6)


def test_contact_forces_are_those_of_the_batch() -> None:
    """On an ant that has just landed, in one substep: C MuJoCo and MuJoCo Warp see the same contacts."""
    config = load_config("ant")
    env = make_env(config.env, config.physics, 1, "cpu", 0, differentiable=False)
    simulation = CSimulation(env.model, env.sim.substeps)
    state = env.draw_physics(1)
    state.qpos[:, 2] -= 0.35
    control = torch.full((1, env.model.nu), 0.2)
    floor = env.model.geom("floor").id
    query = ContactQuery(((floor,), tuple(range(env.model.ngeom))), (floor,))
    env.sim.step(control, *state)
    simulation.step(control, *state)
    expected, forces = env.sim.contact_forces(), simulation.contact_forces()
    assert expected.abs().max() > 10.0
    assert forces == pytest.approx(expected, abs=0.02 * float(expected.abs().max()))
    with pytest.raises(ConfigError, match="did not watch these contacts"):
        simulation.contacts(query)
    for each in (env.sim, simulation):
        each.measure_contacts(query)
        each.step(control, *state)
    for one, other in zip(env.sim.contacts(query), simulation.contacts(query), strict=True):
        assert other.shape == one.shape
        assert other.float() == pytest.approx(one.float(), abs=0.02 * float(one.float().abs().max()))


@pytest.mark.filterwarnings("ignore:the model may stop the constraint solver")
def test_a_model_that_stops_its_solver_early_is_solved_to_the_end() -> None:
    """As in a batch, unless limits are given."""
    model, (point,) = ant("elliptic"), ant_points(ant("elliptic"), 3, seed=1)[2:]
    hasty = copy.copy(model)
    hasty.opt.iterations = hasty.opt.ls_iterations = 1
    given = (torch.tensor(v[None], dtype=torch.float32) for v in (point.ctrl, point.qpos, point.qvel, point.act))
    control, *state = given
    expected = CSimulation(model, 2).step(control, *state).qvel
    torch.testing.assert_close(CSimulation(hasty, 2).step(control, *state).qvel, expected)
    early = CSimulation(hasty, 2, SolverLimits(1, 1)).step(control, *state).qvel
    assert (early - expected).abs().max() > 0.05
    assert (hasty.opt.iterations, hasty.opt.ls_iterations) == (1, 1)


def test_a_step_goes_on_in_float64_where_the_last_one_ended() -> None:
    config = load_config("cartpole")
    env = make_env(config.env, config.physics, 1, "cpu", 0, differentiable=False)
    simulation = CSimulation(env.model, 4)
    state = simulation.step(torch.ones(1, 1), *env.draw_physics(1))
    ended = simulation.data.qpos.copy()
    simulation.data.time = 5.0
    simulation.step(torch.ones(1, 1), *state)
    assert simulation.data.time > 5.0, "the same state: no reset"
    assert np.any(ended != ended.astype(np.float32)), "float64"
    state.qpos[:, 0] += 1.0
    simulation.step(torch.ones(1, 1), *state)
    assert simulation.data.time < 1.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BatchedEnv("cartpole", 2, arrays="jax"), "arrays 'jax': write numpy or torch"),
        (lambda: BatchedEnv("cartpool"), "unknown config 'cartpool'"),
        (lambda: SingleEnv("cartpole").step(np.zeros(2)), r"the action has shape \(2,\), not \(1,\)"),
        (lambda: SingleEnv("cartpole").reset(options={"x": 1}), "reset takes no options, but got x"),
        (
            lambda: SingleEnv(_cartpole(**{"physics.randomize": {"body_mass": {"low": 0.5, "high": 2.0}}})),
            "set it to null, or use BatchedEnv",
        ),
    ],
)
def test_what_cannot_be_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()


def test_without_gymnasium_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs gymnasium: pip install 'msk-ray\[gym\]'"):
        importlib.reload(msk_ray.gym)


def test_actions_of_another_shape_are_refused(batched: BatchedEnv[np.ndarray]) -> None:
    with pytest.raises(ConfigError, match=r"actions have shape \(4,\), but 4 worlds take \(4, 1\)"):
        batched.step(np.zeros(4, np.float32))


def _fall(env: BatchedEnv[Any], action: Any) -> None:
    """A second in which an ant comes down."""
    for _ in range(60):
        env.step(action)


def test_lost_contacts_are_an_error() -> None:
    config = load_config("ant", ["execution.nconmax=1", "execution.njmax=4"])
    env: BatchedEnv[np.ndarray] = BatchedEnv(config, 1)
    env.reset(seed=0)
    with pytest.raises(SimulationError, match=r"execution\.n(con|j)max"):
        _fall(env, np.zeros((1, 8), np.float32))


@pytest.mark.gpu
def test_tensors_stay_on_the_gpu_and_lost_contacts_are_an_error_there() -> None:
    env: BatchedEnv[torch.Tensor] = BatchedEnv("ant", 4, "cuda", arrays="torch")
    obs, _ = env.reset(seed=0)
    obs, reward, terminated, *_ = env.step(torch.zeros(4, 8, device="cuda"))
    assert {t.device.type for t in (obs, reward, terminated)} == {"cuda"}
    tight: BatchedEnv[torch.Tensor] = BatchedEnv(
        load_config("ant", ["execution.nconmax=1", "execution.njmax=4"]), 1, "cuda", arrays="torch"
    )
    tight.reset(seed=0)
    with pytest.raises(SimulationError, match=r"execution\.n(con|j)max"):
        _fall(tight, torch.zeros(1, 8, device="cuda"))


def test_an_environment_from_outside(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(root / "docs" / "examples")
    env: BatchedEnv[np.ndarray] = BatchedEnv(root / "docs" / "examples" / "tray.yaml", 2)
    obs, _ = env.reset(seed=0)
    assert obs.shape == (2, 2)
    assert np.isfinite(env.step(env.action_space.sample())[1]).all()


def _mean_return(model: PPO, env: StableBaselinesEnv) -> float:
    env.seed(9)
    obs = env.reset()
    total = 0.0
    for _ in range(60):
        obs, reward, _, _ = env.step(model.predict(obs, deterministic=True)[0])
        total += float(reward.mean())
    return total


def test_ppo_of_stable_baselines_learns_cartpole() -> None:
    """Within four rounds it holds a pole that starts near upright; untrained, it lets it fall."""
    env = StableBaselinesEnv(_cartpole(**{"env.episode_length": 60, "env.nworld": 64}))
    cart = env.batched.env
    cart._hanging[1], cart._spread[1] = 0.0, 0.3
    settings = {"n_steps": 30, "batch_size": 240, "n_epochs": 8, "learning_rate": 2e-3, "gamma": 0.95}
    model = PPO("MlpPolicy", VecNormalize(env, norm_obs=False), seed=0, device="cpu", **settings)
    untrained = _mean_return(model, env)
    model.learn(4 * 30 * 64)
    assert _mean_return(model, env) > 0.25 * untrained  # a quarter of the penalties
