"""What disturbs a policy in training: errors, delays and pushes, their gradients, scores without them, resumption."""

import math
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch
from disturbed import DISTURBANCES
from torch import Tensor

from msk_ray.config import Config, PhysicsConfig, overlay, parse_config
from msk_ray.envs import Env, make_env
from msk_ray.envs.cartpole.env import CartPole
from msk_ray.envs.disturbances import uniform_hash
from msk_ray.envs.layout import Entry
from msk_ray.errors import ConfigError
from msk_ray.group import Group
from msk_ray.step import StepState
from msk_ray.training import Trainer
from msk_ray.training.evaluation import Evaluator

W = 64


def cartpole(worlds: int = W, length: int = 40, seed: int = 0, **randomize: Any) -> Env[Any]:
    config = parse_config({"env": {"name": "cartpole", "episode_length": length}})
    physics = PhysicsConfig.model_validate({"randomize": randomize or None})
    return make_env(config.env, physics, worlds, "cpu", seed, randomize=True)


def clean(env: Env[Any]) -> Tensor:
    return env.observe(env.state.physics, env.state.action)


def test_noise_follows_its_distribution_and_is_the_same_each_time_a_state_is_observed() -> None:
    env = cartpole(512, observation_noise=DISTURBANCES["observation_noise"])
    noise = []
    for _ in range(20):
        noise.append(env.observation() - clean(env))
        assert torch.equal(noise[-1], env.observation() - clean(env))
        transition = env.step(torch.zeros(512, 1))
        assert torch.equal(transition.obs, env.observation())
    every = torch.stack(noise)
    assert not every[..., 2:4].any()
    assert float(every[..., :2].abs().max()) == pytest.approx(0.5, abs=1e-3)
    assert every.std((0, 1)).tolist() == pytest.approx([0.5 / math.sqrt(3.0)] * 2 + [0.0, 0.0, 0.2], rel=0.02)
    assert every.mean((0, 1)).tolist() == pytest.approx([0.0] * 5, abs=0.01)
    kinds = torch.corrcoef(
        torch.stack((every[:-1, :-1, 0], every[1:, :-1, 0], every[:-1, 1:, 0], every[:-1, :-1, 1])).flatten(1)
    )
    assert float((kinds - torch.eye(4)).abs().max()) < 0.04, "steps, worlds and entries have noise of their own"


def test_the_critic_sees_the_undisturbed_observation() -> None:
    env = cartpole(**DISTURBANCES)
    env.step(torch.zeros(W, 1))
    assert env.asymmetric
    assert torch.equal(env.critic_observation(), clean(env))
    assert not torch.equal(env.observation(), clean(env))
    assert not cartpole(push=DISTURBANCES["push"]).asymmetric


def test_hashes_are_uniform_and_rarely_repeat() -> None:
    drawn = uniform_hash(torch.linspace(0.0, 1.0, 101)[:-1], torch.arange(100), 1000)
    assert torch.histc(drawn, 10, 0.0, 1.0).tolist() == pytest.approx([1e4] * 10, rel=0.03)
    assert float(drawn.min()) >= 0.0
    assert float(drawn.max()) < 1.0
    assert len(drawn.unique()) > 0.99 * drawn.numel()


def test_a_bias_stays_for_an_episode_and_rewards_use_the_clean_observation() -> None:
    env, plain = cartpole(length=5, observation_bias={"cart_position": {"uniform": 0.1}}), cartpole(length=5)
    seen = []
    for _ in range(10):
        seen.append((env.observation() - plain.observation())[:, 0])
        action = torch.zeros(W, 1)
        assert torch.equal(env.step(action).terms, plain.step(action).terms)
    for episode in (seen[:5], seen[5:]):
        torch.testing.assert_close(torch.stack(episode), episode[0].expand(5, W), atol=1e-6, rtol=0.0)
        assert 0.05 < float(episode[0].abs().max()) <= 0.1
    assert (seen[0] - seen[5]).abs().min() > 1e-5


class Servo(CartPole):
    """A position servo in place of the motor."""

    @classmethod
    def build_model(cls, config: Any, physics: PhysicsConfig) -> mujoco.MjModel:
        model = super().build_model(config, physics)
        model.actuator_gear[0, 0], model.actuator_gainprm[0, 0] = 2.0, 5.0
        model.actuator_biastype[0], model.actuator_biasprm[0, 1] = int(mujoco.mjtBias.mjBIAS_AFFINE), -5.0
        return model

    def observation_layout(self) -> list[Entry]:
        return [Entry("slider_position", "m"), *super().observation_layout()[1:]]


def servo(**randomize: Any) -> Env[Any]:
    config = parse_config({"env": {"name": f"{__name__}:Servo", "episode_length": 5}})
    physics = PhysicsConfig.model_validate({"randomize": randomize or None})
    return make_env(config.env, physics, W, "cpu", 0, randomize=True)


def test_servos_follow_the_bias_of_their_encoders() -> None:
    """A joint of gear 2 that is shown at q + b goes where an unbiased servo goes with the control − 2 b."""
    env, plain = servo(encoder_bias={"slid*": {"uniform": 0.1}}), servo()
    biases = []
    for _ in range(10):
        env.state = env.state.detach()
        plain.state = plain.state._replace(physics=env.state.physics)
        error = env.observation() - plain.observation()
        assert not error[:, 1:].any()
        assert torch.equal(env.critic_observation(), plain.observation())
        biases.append(error[:, 0])
        sent = torch.full((W, 1), 0.3, requires_grad=True)
        same = (0.3 - 2.0 * biases[-1][:, None]).requires_grad_()
        slopes = []
        for environment, control in ((env, sent), (plain, same)):
            environment.step(control, auto_reset=environment is env)
            reached = environment.state.physics
            slopes.append(torch.autograd.grad(reached.qpos.sum(), control, allow_unused=True)[0])
        if len(biases) % 5:  # no reset
            torch.testing.assert_close(env.state.physics, plain.state.physics, rtol=1e-5, atol=1e-6)
            torch.testing.assert_close(*slopes, rtol=1e-5, atol=1e-7)
            assert slopes[0].abs().min() > 1e-4
    for episode in (biases[:5], biases[5:]):
        torch.testing.assert_close(torch.stack(episode), episode[0].expand(5, W), atol=1e-6, rtol=0.0)
        assert 0.05 < float(episode[0].abs().max()) <= 0.1
    assert (biases[0] - biases[5]).abs().min() > 1e-5


def test_a_late_observation_keeps_the_noise_of_its_own_step() -> None:
    noise = {"cart_position": {"uniform": 0.1}}
    late, prompt = cartpole(observation_noise=noise, observation_delay=[2, 2]), cartpole(observation_noise=noise)
    late.state = late.state._replace(numbers=torch.cat((prompt.state.numbers, late.state.numbers[:, 1:]), dim=1))
    given, prompts = [], []
    for step in range(6):
        given.append(late.observation())
        prompts.append(prompt.observation())
        assert torch.equal(given[-1], prompts[max(step - 2, 0)])
        action = 0.1 * step * torch.ones(W, 1)
        obs = late.step(action).obs
        prompt.step(action)
        assert torch.equal(obs, late.observation())


def test_each_episode_draws_its_own_delay_even_if_ages_are_spread() -> None:
    env = cartpole(length=10, observation_delay=[0, 2])
    env.spread_ages()
    past, delays = [clean(env)], []
    for step in range(2):
        env.step(torch.ones(W, 1))
        past.append(clean(env))
        lag = torch.stack([(env.observation() == earlier).all(-1) for earlier in reversed(past)]).float().argmax(0)
        going = env.state.age > step
        delays.append(lag[going])
        assert bool((torch.stack([(env.observation() == p).all(-1) for p in past]).any(0) | ~going).all())
    assert set(delays[-1].tolist()) == {0, 1, 2}


def recalling(**randomize: Any) -> Env[Any]:
    config = parse_config({"env": {"name": "disturbed:Recalling"}})
    physics = PhysicsConfig.model_validate({"randomize": randomize or None})
    return make_env(config.env, physics, W, "cpu", 0, randomize=True)


@pytest.mark.parametrize("delay", [[0, 0], [0, 2]])
def test_a_history_holds_what_the_policy_was_given_then(delay: list[int]) -> None:
    errors = {name: {"*": {"uniform": 0.1}} for name in ("observation_noise", "observation_bias")}
    env = recalling(observation_delay=delay, **errors)
    given = [torch.zeros(W, 5), torch.zeros(W, 5), env.observation()[:, :5]]
    for _ in range(6):
        obs = env.step(torch.zeros(W, 1)).obs
        assert torch.equal(obs, env.observation())
        given.append(obs[:, :5])
        assert torch.equal(obs[:, 5:], torch.cat((given[-2], given[-3]), dim=-1))
    assert (given[-1] - clean(env)[:, :5]).abs().amin() > 0.0


def test_a_sensor_has_the_same_bias_in_all_frames_and_none_in_scores() -> None:
    env, plain = recalling(observation_bias={"*": {"uniform": 0.1}}), recalling()
    for _ in range(3):
        env.step(torch.zeros(W, 1))
        plain.step(torch.zeros(W, 1))
    error = (env.observation() - plain.observation()).unflatten(-1, (3, 5))
    torch.testing.assert_close(error, error[:, :1].expand_as(error), atol=1e-6, rtol=0.0)
    assert error.abs().amax() > 0.09
    assert torch.equal(plain.observation(), clean(plain))


def test_gradients_flow_through_a_history_with_errors() -> None:
    env, plain = recalling(observation_noise={"*": {"uniform": 0.1}}), recalling()
    gradients = []
    for each in (env, plain):
        first = torch.zeros(W, 1, requires_grad=True)
        each.step(first)
        obs = each.step(torch.zeros(W, 1)).obs
        gradients.append(torch.autograd.grad(obs[:, 5:].sum(), first)[0])
    assert torch.equal(*gradients)
    assert gradients[0].abs().amin() > 0.0


def test_late_controls_act_later_with_their_gradient() -> None:
    env, prompt = cartpole(control_delay=[2, 2]), cartpole()
    actions = [torch.full((W, 1), 0.1 * (step + 1), requires_grad=True) for step in range(5)]
    for env_, given in ((env, actions), (prompt, [actions[0], actions[0], actions[0], actions[1], actions[2]])):
        for action in given:
            env_.step(action)
    torch.testing.assert_close(env.state.physics, prompt.state.physics, rtol=0.0, atol=0.0)
    gradients = [torch.autograd.grad(e.state.physics.qvel.sum(), actions, allow_unused=True) for e in (env, prompt)]
    for mine, expected in zip(*gradients, strict=True):
        mine, expected = (torch.zeros(W, 1) if g is None else g for g in (mine, expected))
        torch.testing.assert_close(mine, expected, rtol=1e-5, atol=1e-7)
    assert gradients[1][2] is not None
    assert not (torch.zeros(1) if gradients[0][4] is None else gradients[0][4]).any()


def test_gradients_flow_through_errors_and_late_observations() -> None:
    env = cartpole(observation_delay=[1, 1], observation_noise=DISTURBANCES["observation_noise"])
    first, second = (torch.zeros(W, 1, requires_grad=True) for _ in range(2))
    env.step(first)
    expected = torch.autograd.grad(clean(env).sum(), first, retain_graph=True)[0]
    obs = env.step(second).obs
    to_first, to_second = torch.autograd.grad(obs.sum(), (first, second), allow_unused=True)
    assert torch.equal(to_first, expected)
    assert to_second is None or not to_second.any()


def test_pushes_have_the_configured_times_and_sizes() -> None:
    pushed, plain = (cartpole(256, push=p) if p else cartpole(256) for p in (DISTURBANCES["push"], None))
    sizes, steps = [], []
    for step in range(39):
        plain.state = plain.state._replace(physics=pushed.state.physics)
        change = pushed.disturbances.pushed(pushed.state.physics, pushed.state).qvel - pushed.state.physics.qvel
        assert not change[:, 1].any()
        if step == 0:
            assert not change.any()
        hit = change[:, 0] != 0.0
        sizes.append(change[hit, 0])
        steps.append(hit)
        pushed.step(torch.zeros(256, 1))
        plain.step(torch.zeros(256, 1))
        moved = (pushed.state.physics.qvel != plain.state.physics.qvel).any(-1)
        assert torch.equal(moved, hit)
    every = torch.cat(sizes)
    assert 0.45 < float(every.abs().max()) <= 0.5
    assert abs(float(every.mean())) < 0.05
    # One in 0.06 s on average, which is 3.6 env steps.
    assert float(torch.stack(steps).float().mean()) == pytest.approx(1.0 / 3.6, rel=0.1)


def test_disturbances_leave_initial_states_and_parameters_unchanged() -> None:
    mass = {"body_mass": {"low": 0.5, "high": 2.0}}
    both, alone = cartpole(**DISTURBANCES, **mass), cartpole(**mass)
    assert torch.equal(both.state.physics.qpos, alone.state.physics.qpos)
    assert torch.equal(both.parameters["body_mass"], alone.parameters["body_mass"])
    assert not cartpole().disturbances.size
    assert cartpole().state.numbers.shape == (W, 0)


@pytest.fixture
def config(tiny_settings: dict[str, Any]) -> Config:
    """A CartPole trial of seconds under all disturbances."""
    return parse_config(overlay(tiny_settings, {"physics.randomize": DISTURBANCES, "env.episode_length": 4}))


def test_scores_are_bitwise_the_same_with_and_without_disturbances(config: Config) -> None:
    plain = config.model_copy(update={"physics": PhysicsConfig()})
    policy = lambda obs: obs[:, :1].tanh()  # noqa: E731
    ours, without = (Evaluator(c, "cpu").episodes(policy).score for c in (config, plain))
    assert torch.equal(ours, without)
    assert make_env(config.env, config.physics, 2, "cpu", 0).disturbances.size == 0


@pytest.mark.long
@pytest.mark.parametrize("algorithm", ["shac", "ppo"])
def test_a_resumed_trial_is_bitwise_the_same(config: Config, tmp_path: Path, algorithm: str) -> None:
    settings = config.as_dict()
    if algorithm == "ppo":
        del settings["shac"]
        settings |= {"algorithm": {"name": "ppo"}, "ppo": {"steps": 8}}
    trial = parse_config(settings)
    hashes = []
    for name, stops in (("whole", []), ("cut", [3])):
        for stop in (*stops, None):
            trainer = Trainer(trial, tmp_path / name, "cpu")
            if stop is None and stops:
                trainer.restore_latest()
            while not trainer.finished and trainer.epoch != stop:
                trainer.run_epoch()
            hashes.append(trainer.algorithm.parameter_hash())
            trainer.close()
    assert hashes[0] == hashes[-1]
    assert hashes[1] != hashes[0]


class Half(Group):
    """One of two processes, which nobody else has to be there for."""

    size = 2

    def own(self, values: Tensor, dim: int = 0) -> Tensor:
        return values.chunk(2, dim)[self.rank]


def test_several_processes_draw_the_same_disturbances_as_one() -> None:
    whole = cartpole(8, **DISTURBANCES)
    for rank in range(2):
        half, group = cartpole(4, **DISTURBANCES), Half()
        group.rank = rank
        half.join(group)
        assert torch.equal(half.state.numbers, whole.state.numbers.chunk(2)[rank])


class Hidden(Servo):
    """Does not call the position of the joint by its name."""

    def observation_layout(self) -> list[Entry]:
        return CartPole.observation_layout(self)


def test_a_biased_joint_has_to_be_in_the_observation() -> None:
    trial = parse_config(
        {"env": {"name": f"{__name__}:Hidden"}, "physics": {"randomize": {"encoder_bias": {"*": {"uniform": 0.1}}}}}
    )
    with pytest.raises(ConfigError, match="does not show joint 'slider' as slider_angle or slider_position"):
        make_env(trial.env, trial.physics, 2, "cpu", 0, randomize=True)


class Twofold(CartPole):
    """Observes everything twice, under names as long as a robot's."""

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return super().observe(state, action).repeat(1, 2)

    def observation_layout(self) -> list[Entry]:
        return [Entry(f"{entry.name}_{'of_a_joint_' * 10}", "") for entry in super().observation_layout()] * 2


def test_an_unknown_name_lists_each_known_name_once_and_not_too_many() -> None:
    trial = parse_config({"env": {"name": f"{__name__}:Twofold"}})
    physics = PhysicsConfig.model_validate({"randomize": {"observation_noise": {"hip": {"uniform": 0.1}}}})
    with pytest.raises(ConfigError, match="no entry of the observation is 'hip'; it has cart_position") as refused:
        make_env(trial.env, physics, 2, "cpu", 0, randomize=True)
    assert str(refused.value).count("cart_position") == 1
    assert len(str(refused.value)) < 500


class Unnamed(CartPole):
    """Does not say what its observation is."""

    def observation_layout(self) -> None:  # type: ignore[override]
        return None


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "unknown entry": ({"observation_noise": {"pole": {"uniform": 1.0}}}, "no entry .* is 'pole'; it has cart_position"),
    "entry twice": (
        {"observation_bias": {"*": {"uniform": 1.0}, "pole_rate": {"normal": 1.0}}},
        "'pole_rate' is both '\\*' and 'pole_rate'; leave one out",
    ),
    "no servo": (
        {"encoder_bias": {"slider": {"uniform": 0.1}}},
        "no position servo of a joint.* write observation_bias",
    ),
    "two distributions": (
        {"observation_noise": {"*": {"uniform": 1.0, "normal": 1.0}}},
        "write one of uniform, normal",
    ),
    "no distribution": ({"observation_noise": {"*": {}}}, "write one of uniform, normal"),
    "delay of part steps": ({"control_delay": [0, 0.5]}, "control_delay"),
    "delay the other way round": ({"observation_delay": [2, 1]}, "write the smaller number first"),
    "unknown joint": ({"push": {"every": [1, 2], "velocity": {"root": [1]}}}, "no joint 'root'; it has"),
    "too many velocities": (
        {"push": {"every": [1, 2], "velocity": {"slider": [1, 1]}}},
        "slider: write 1 numbers, one for each velocity of the joint, not 2",
    ),
    "nothing": ({"push": None}, "write at least one of"),
}


def cartpole_trial(randomize: dict[str, Any]) -> None:
    trial = parse_config({"env": {"name": "cartpole"}, "physics": {"randomize": randomize}})
    make_env(trial.env, trial.physics, 2, "cpu", 0, randomize=True)


@pytest.mark.parametrize("name", REFUSED)
def test_a_senseless_section_is_refused(name: str) -> None:
    section, why = REFUSED[name]
    with pytest.raises(ConfigError, match=why):
        cartpole_trial(section)


def test_an_observation_without_named_entries_cannot_be_disturbed() -> None:
    trial = parse_config(
        {"env": {"name": f"{__name__}:Unnamed"}, "physics": {"randomize": {"observation_delay": [1, 1]}}}
    )
    with pytest.raises(
        ConfigError, match=r"observation_delay: Unnamed does not name .* write its method observation_layout"
    ):
        make_env(trial.env, trial.physics, 2, "cpu", 0, randomize=True)
