"""Environments: documented numbers, resets, truncation against termination, divergence."""

import math

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.config import PhysicsConfig, parse_config
from msk_ray.envs import make_env
from msk_ray.envs.ant.config import AntReward, AntSettings
from msk_ray.envs.ant.env import Ant
from msk_ray.envs.ant.model import VARIANTS, build_ant
from msk_ray.envs.cartpole.config import CartPoleSettings
from msk_ray.envs.cartpole.env import CartPole
from msk_ray.step import StepState


@pytest.fixture(scope="module")
def cartpole() -> CartPole:
    return make_env(CartPoleSettings(name="cartpole", episode_length=3), PhysicsConfig(), 4, "cpu", 0)


@pytest.fixture(scope="module")
def ant() -> Ant:
    config = AntSettings(name="ant", episode_length=50)
    return make_env(config, PhysicsConfig(), 4, "cpu", 0, differentiable=False)


def place(env, qpos, qvel=None) -> None:
    """Put every world into one state."""
    fresh = env.reset_state()
    qpos = torch.tensor(qpos).expand(env.nworld, -1).clone()
    qvel = torch.zeros(env.nworld, env.model.nv) if qvel is None else torch.tensor(qvel).expand(env.nworld, -1).clone()
    env.state = fresh._replace(physics=StepState(qpos, qvel, fresh.physics.act))


def named_terms(env, state: StepState, action: torch.Tensor) -> dict[str, torch.Tensor]:
    terms = env.reward_terms(state, action, env.observe(state, action))
    return dict(zip(env.reward_names, terms[0], strict=True))


def test_cartpole_reward_and_observation_by_hand(cartpole: CartPole) -> None:
    state = StepState(torch.tensor([[0.5, math.pi + 1.0]]), torch.tensor([[2.0, 3.0]]), torch.zeros(1, 0))
    action = torch.tensor([[0.5]])
    terms = named_terms(cartpole, state, action)
    # angle wraps to 1 − π
    assert terms["pole_angle"].item() == pytest.approx(-((1 - math.pi) ** 2), rel=1e-5)
    assert terms["pole_velocity"].item() == pytest.approx(-0.9)
    assert terms["cart_position"].item() == pytest.approx(-0.0125)
    assert terms["cart_velocity"].item() == pytest.approx(-0.4)
    obs = cartpole.observe(state, torch.zeros(1, 1))[0]
    assert obs.tolist() == pytest.approx([0.5, 2.0, -math.sin(1.0), -math.cos(1.0), 3.0], rel=1e-5)


def test_an_episode_is_truncated_at_its_length_and_starts_anew(cartpole: CartPole) -> None:
    cartpole.state = cartpole.reset_state()
    with torch.no_grad():
        transitions = [cartpole.step(torch.zeros(4, 1)) for _ in range(3)]
    assert [t.truncated.all().item() for t in transitions] == [False, False, True]
    assert not any(t.terminated.any() for t in transitions)
    assert (cartpole.state.age == 0).all()
    # The observation returned is the one before the reset.
    assert not torch.allclose(transitions[-1].obs, cartpole.observation())


def test_ant_observation_is_in_the_documented_order(ant: Ant) -> None:
    torch.manual_seed(0)
    qpos = torch.cat(
        (torch.tensor([5.0, -3.0, 0.6]), torch.tensor([math.cos(0.2), 0.0, 0.0, math.sin(0.2)]), torch.arange(8.0))
    )
    qvel = torch.arange(14.0)
    state = StepState(qpos[None], qvel[None], torch.zeros(1, 0))
    action = torch.linspace(-1, 1, 8)[None]
    obs = ant.observe(state, action)[0]
    assert obs.shape == (37,)
    assert obs[0] == pytest.approx(0.6)
    assert torch.allclose(obs[1:5], qpos[3:7])
    assert torch.allclose(obs[5:8], qvel[:3])
    # yaw by 0.4 rad turns the body-frame rate (3, 4, 5)
    c, s = math.cos(0.4), math.sin(0.4)
    assert torch.allclose(obs[8:11], torch.tensor([3 * c - 4 * s, 3 * s + 4 * c, 5.0]), atol=1e-5)
    assert torch.allclose(obs[11:19], torch.arange(8.0))
    assert torch.allclose(obs[19:27], 0.1 * torch.arange(6.0, 14.0))
    assert obs[27] == pytest.approx(1.0)
    assert obs[28] == pytest.approx(c, abs=1e-6)
    assert torch.allclose(obs[29:], action[0])


def test_ant_standing_reward_by_hand(ant: Ant) -> None:
    state = StepState(torch.tensor([[0.0, 0, 0.77, 1, 0, 0, 0, *[0.0] * 8]]), torch.zeros(1, 14), torch.zeros(1, 0))
    state.qvel[0, 0] = 1.5
    total = sum(named_terms(ant, state, torch.zeros(1, 8)).values())
    assert total.item() == pytest.approx(1.5 + 0.1 + 1.0 + 0.5)


def test_ant_reward_terms_follow_their_weights() -> None:
    config = AntSettings(
        name="ant", reward=AntReward(forward_vel=3.0, up=2.0, heading=0.5, height=4.0, action_penalty=0.25)
    )
    env = make_env(config, PhysicsConfig(), 1, "cpu", 0, differentiable=False)
    state = StepState(torch.tensor([[0.0, 0, 0.77, 1, 0, 0, 0, *[0.0] * 8]]), torch.zeros(1, 14), torch.zeros(1, 0))
    state.qvel[0, 0] = 1.5
    terms = {name: value.item() for name, value in named_terms(env, state, torch.full((1, 8), 0.5)).items()}
    assert terms == pytest.approx({"forward_vel": 4.5, "up": 2.0, "heading": 0.5, "height": 2.0, "action": -0.5})


def test_an_ant_past_its_joints_ranges_pays_for_the_squared_overshoot() -> None:
    config = AntSettings(name="ant", reward=AntReward(joint_limit=0.5, action_penalty=0.25))
    env = make_env(config, PhysicsConfig(), 1, "cpu", 0, differentiable=False)
    # Hips have 40 degrees to either side, ankles 30 to 100 (legs 1 and 4) or -100 to -30.
    high, low, inside = math.radians(100.0) + 0.3, -math.radians(40.0) - 0.1, math.radians(-50.0)
    joints = [0.0, high, low, inside, 0.0, inside, 0.0, 1.0]
    state = StepState(torch.tensor([[0.0, 0, 0.77, 1, 0, 0, 0, *joints]]), torch.zeros(1, 14), torch.zeros(1, 0))
    terms = named_terms(env, state, torch.full((1, 8), 0.5))
    assert list(terms) == ["forward_vel", "up", "heading", "height", "action", "joint_limit"]
    assert terms["joint_limit"].item() == pytest.approx(-0.5 * (3.0**2 + 1.0**2), rel=1e-5)
    assert terms["action"].item() == pytest.approx(-0.25 * 8 * 0.25)
    assert Ant.reference_settings(config).reward == AntReward(), "scores leave it out"


def test_an_ants_cost_of_joint_ranges_fades() -> None:
    """Half of it after 10 of 20 epochs, nothing from 20 on; an ankle 0.2 rad past its range costs 0.5 (0.2 / 0.1)²."""
    config = AntSettings(name="ant", reward=AntReward(joint_limit=0.5), joint_limit_epochs=20)
    env = make_env(config, PhysicsConfig(), 1, "cpu", 0, differentiable=False)
    joints = [0.0, math.radians(100.0) + 0.2, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0]
    state = StepState(torch.tensor([[0.0, 0, 0.77, 1, 0, 0, 0, *joints]]), torch.zeros(1, 14), torch.zeros(1, 0))
    for epoch, share in ((0, 1.0), (10, 0.5), (20, 0.0), (30, 0.0)):
        env.enter_epoch(epoch)
        found = named_terms(env, state, torch.zeros(1, 8))["joint_limit"].item()
        assert found == pytest.approx(-2.0 * share, rel=1e-4)


@pytest.mark.parametrize("name", ["hopper", "cheetah", "humanoid"])
def test_other_bodies_pay_for_joints_past_their_ranges_too(name: str) -> None:
    """0.2 rad below the range of the last joint, 0.1 rad above that of the first: 0.5 (2² + 1²), half of it later."""
    config = parse_config(
        {"env": {"name": name, "nworld": 1, "reward": {"joint_limit": 0.5}, "joint_limit_epochs": 20}}
    ).env
    env = make_env(config, PhysicsConfig(), 1, "cpu", 0, differentiable=False)
    joints = np.flatnonzero(env.model.jnt_limited)
    assert len(joints) == env.action_size, "every driven joint has a range"
    qpos = torch.zeros(1, env.model.nq)
    at, ranges = env.model.jnt_qposadr[joints], env.model.jnt_range[joints]
    qpos[0, at] = torch.tensor(ranges.mean(-1), dtype=torch.float32)
    qpos[0, at[-1]] = ranges[-1, 0] - 0.2
    qpos[0, at[0]] = ranges[0, 1] + 0.1
    state = StepState(qpos, torch.zeros(1, env.model.nv), torch.zeros(1, 0))
    for epoch, share in ((0, 1.0), (10, 0.5), (20, 0.0)):
        env.enter_epoch(epoch)
        found = named_terms(env, state, torch.zeros(1, env.action_size))
        assert list(found)[-1] == "joint_limit"
        assert found["joint_limit"].item() == pytest.approx(-2.5 * share, rel=1e-4)
    assert type(env).reference_settings(config).reward == type(config.reward)(), "scores leave it out"


def test_an_ant_that_falls_terminates_and_restarts(ant: Ant) -> None:
    place(ant, [0.0, 0, 0.2, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1])
    with torch.no_grad():
        transition = ant.step(torch.zeros(4, 8))
    assert transition.terminated.all()
    assert not transition.truncated.any()
    assert (transition.obs[:, 0] < 0.27).all(), "the observation is the fallen one"
    assert (ant.state.physics.qpos[:, 2] > 0.5).all(), "the state is a fresh one"


def test_a_diverged_world_is_reset_counted_and_kept_out_of_the_gradient() -> None:
    env = make_env(CartPoleSettings(name="cartpole"), PhysicsConfig(), 3, "cpu", 0)
    qvel = env.state.physics.qvel.clone()
    qvel[1, 0] = float("nan")
    env.state = env.state._replace(physics=env.state.physics._replace(qvel=qvel))
    action = torch.zeros(3, 1, requires_grad=True)
    transition = env.step(action)
    assert transition.diverged.tolist() == [False, True, False]
    assert transition.terminated.tolist() == [False, True, False]
    assert transition.reward[1] == 0
    assert torch.equal(transition.terms.sum(-1), transition.reward.detach())
    transition.reward.sum().backward()
    assert action.grad.isfinite().all()
    assert action.grad[1] == 0
    assert (action.grad[[0, 2]] != 0).all()
    assert env.state.physics.qvel.isfinite().all()


def test_what_a_cpu_leaves_out_where_no_world_is_concerned_changes_nothing(
    cartpole: CartPole, monkeypatch: pytest.MonkeyPatch
) -> None:
    """States, rewards and gradients over five steps, in the third of which all episodes end."""
    runs = []
    for looks in (True, False):
        if not looks:  # as on a GPU
            monkeypatch.setattr("msk_ray.envs.base.known_none", lambda _: False)
            monkeypatch.setattr("msk_ray.step.autograd.simulation.known_none", lambda _: False)
        cartpole.generator.manual_seed(1)
        cartpole.state = cartpole.reset_state()
        actions = torch.linspace(-0.9, 0.8, 20).view(5, 4, 1).requires_grad_()
        steps = [cartpole.step(action) for action in actions]
        rewards = torch.stack([step.reward for step in steps])
        (gradient,) = torch.autograd.grad(rewards.sum(), actions)
        assert [step.truncated.any().item() for step in steps] == [False, False, True, False, False]
        runs.append((rewards.detach(), gradient, *cartpole.state.detach().physics, cartpole.state.age))
        cartpole.release_graph()
    assert all(map(torch.equal, *runs))


def test_resets_are_the_same_for_the_same_seed_and_differ_between_worlds() -> None:
    make = lambda seed: make_env(AntSettings(name="ant"), PhysicsConfig(), 4, "cpu", seed, differentiable=False)  # noqa: E731
    first, again, other = make(5).state.physics.qpos, make(5).state.physics.qpos, make(6).state.physics.qpos
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert not torch.equal(first[0], first[1])
    assert torch.allclose(first[:, 3:7].norm(dim=-1), torch.ones(4))


@pytest.mark.parametrize("variant", sorted(VARIANTS))
def test_every_ant_variant_has_the_documented_layout(variant: str) -> None:
    model = build_ant(AntSettings(name="ant"), PhysicsConfig(variant=variant))
    assert (model.nq, model.nv, model.nu, model.npair) == (15, 14, 8, 13)
    assert model.opt.timestep == pytest.approx(1 / 240)
    assert [model.joint(i).name for i in range(1, 9)] == [f"{j}_{k}" for k in range(1, 5) for j in ("hip", "ankle")]
    assert [model.actuator(i).trnid[0] for i in range(8)] == list(range(1, 9))


def test_physics_knobs_reach_the_model() -> None:
    knobs = PhysicsConfig(
        variant="published", cone="elliptic", solref=(0.05, 1.0), solreffriction=(0.33, 1.0), substeps=8,
    )  # fmt: skip
    model = build_ant(AntSettings(name="ant"), knobs)
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.timestep == pytest.approx(1 / 480)
    assert (model.pair_solref == [0.05, 1.0]).all()
    assert (model.pair_solreffriction == [0.33, 1.0]).all()


def test_settings_override_what_springs_would_set() -> None:
    own = PhysicsConfig(variant="matched_springs")
    other = PhysicsConfig(variant="matched_springs", solref=(0.05, 1.0), solreffriction=(0.33, 1.0))
    springs, changed = (build_ant(AntSettings(name="ant"), physics) for physics in (own, other))
    assert (changed.pair_solref == [0.05, 1.0]).all()
    assert (changed.pair_solreffriction == [0.33, 1.0]).all()
    assert (changed.pair_solimp == springs.pair_solimp).all()
    assert (changed.jnt_solref == springs.jnt_solref).all()
    assert not (springs.pair_solref == changed.pair_solref).any()


def test_a_pyramid_drops_the_softened_friction_it_cannot_have() -> None:
    model = build_ant(AntSettings(name="ant"), PhysicsConfig(variant="matched", cone="pyramidal"))
    assert (model.pair_solreffriction == 0).all()


def test_scores_are_taken_under_reference_weights_and_physics() -> None:
    trained = AntSettings(name="ant", reward=AntReward(forward_vel=5.0, up=0.0), nworld=7)
    reference = Ant.reference_settings(trained)
    assert (reference.reward.forward_vel, reference.reward.up, reference.nworld) == (1.0, 0.1, 7)
    physics = Ant.reference_physics(PhysicsConfig(variant="published", solref=(0.1, 1.0)), None)
    assert physics == PhysicsConfig(variant="matched")
