"""Rewards made of terms: one list gives names, weights, settings and what they need."""

import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from walkers import SOUND

from msk_ray.config import Config, EnvSettings, parse_config
from msk_ray.config.terms import Term
from msk_ray.envs import Env, env_class, make_env
from msk_ray.envs.ant.config import AntReward, AntSettings
from msk_ray.envs.ant.env import Ant
from msk_ray.errors import ConfigError

SHIPPED = ("cartpole", "ant", "hopper", "cheetah", "humanoid", "myoleg26", "myoleg", "myosuite_walk")
OF_TERMS = """
from msk_ray import Cost, Term
from msk_ray.config import Reward
from msk_ray.config.sections import Section

def forward(env, state, action, obs):
    return state.qvel[:, 0]

def near(env, state, action, obs):
    return (-(state.qpos[:, 0] / env.config.reward.width).square()).exp()

def effort(env, state, action, obs):
    return action.square().mean(-1)

def fading(settings, epoch):
    return 0.5 ** epoch

class Shape(Reward):
    width: float = 2.0

class Listed(Walker):
    class Settings(MjcfEnv.Settings):
        sensor: bool = False
        reward: Shape = Shape()

    terms = (
        Term("forward", 1.0, forward),
        Term("near", 0.0, near, needs=("sensor", "reward.width"), optional=True, schedule=fading),
        Cost("effort", 0.5, effort, setting="effort_cost"),
    )
    reward_terms = MjcfEnv.reward_terms

class More(Listed):
    terms = (*Listed.terms, Term("steady", 2.0, lambda env, state, action, obs: state.qvel[:, 0].square()))

class Fewer(Listed):
    terms = Listed.terms[:1]
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "listed.py").write_text(SOUND + OF_TERMS)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("listed", None)


def parsed(name: str = "Listed", **env: Any) -> Config:
    return parse_config({"env": {"name": f"listed:{name}", "nworld": 2, **env}})


def make(name: str = "Listed", differentiable: bool = False, **env: Any) -> Env[Any]:
    config = parsed(name, **env)
    return make_env(config.env, config.physics, 2, "cpu", 0, differentiable=differentiable)


def terms_of(env: Env[Any], rate: float = 3.0) -> dict[str, float]:
    state = env.state.physics._replace(qpos=torch.full((2, 1), 2.0), qvel=torch.full((2, 1), rate))
    action = torch.full((2, 1), 0.5)
    terms = env.reward_terms(state, action, env.observe(state, action))
    return dict(zip(env.reward_names, terms[0].tolist(), strict=True))


@pytest.mark.parametrize("name", SHIPPED)
def test_every_term_of_ours_has_a_function_that_says_what_it_measures(name: str) -> None:
    env = env_class(parse_config({"env": {"name": name}}).env)
    assert env.terms
    assert env.Settings.model_fields["reward"].annotation.terms == env.terms
    for term in env.terms:
        assert term.measure.__doc__, term.name


def test_weights_are_settings_and_the_rest_of_the_section_stays(home: Path) -> None:
    assert parsed().env.reward.model_dump() == {"width": 2.0, "forward": 1.0, "near": 0.0, "effort_cost": 0.5}
    assert parsed("More").env.reward.model_dump() == {**parsed().env.reward.model_dump(), "steady": 2.0}
    assert set(parsed("Fewer").env.reward.model_dump()) == {"width", "forward"}
    for settings, message in (
        ({"effort_cost": -1.0}, "env.reward.effort_cost: Input should be greater than or equal to 0"),
        ({"effort": 1.0}, "env.reward.effort: unknown key; did you mean 'effort_cost'"),
    ):
        with pytest.raises(ConfigError, match=message):
            parsed(reward=settings)


def test_a_term_is_weight_times_value_and_an_optional_one_is_there_where_it_has_a_weight(home: Path) -> None:
    assert terms_of(make()) == pytest.approx({"forward": 3.0, "effort": -0.5 * 0.25})
    env = make("More", sensor=True, reward={"near": 4.0, "width": 1.0, "effort_cost": 2.0, "steady": 0.0})
    near = 4.0 * torch.tensor(-4.0).exp().item()
    assert terms_of(env) == pytest.approx({"forward": 3.0, "near": near, "effort": -0.5, "steady": 0.0})
    env.enter_epoch(2)
    assert terms_of(env) == pytest.approx({"forward": 3.0, "near": near / 4.0, "effort": -0.5, "steady": 0.0})
    reference = env.reference_settings(env.config)
    assert reference.reward == type(env).Settings(name="listed:More").reward


def test_what_a_term_needs_is_asked_for_with_it_and_refused_without_it(home: Path) -> None:
    with pytest.raises(ConfigError, match=r"env\.reward\.near needs env\.sensor: write env\.sensor: true"):
        parsed(reward={"near": 1.0})
    with pytest.raises(ConfigError, match=r"env\.reward\.width: nothing reads it while env\.reward\.near is 0;"):
        parsed(reward={"width": 1.0})


MISTAKES = {
    "shape": ("return state.qvel[:, 0]", "return state.qvel", r"term 'forward' of Listed has shape \(2, 1\)?"),
    "exception": ("return state.qvel[:, 0]", "return state.qvl", r"term 'forward' of Listed: .*'qvl'.*\(listed.py:"),
    "written": ("return action.square()", "return action.mul_(2.0)", "term 'effort' of Listed changes action in place"),
    "two of a name": ('Term("near"', 'Term("forward"', "two terms have the name 'forward'"),
    "a need": ('"reward.width")', '"reward.wide")', "term 'near' needs env.reward.wide, which Settings does not have"),
    "a negative cost": ('Cost("effort", 0.5', 'Cost("effort", -0.5', "cost 'effort' needs a weight of at least 0"),
    "no function": ("1.0, forward)", "1.0)", "term 'forward' has no function"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_a_term_is_named(home: Path, mistake: str) -> None:
    right, wrong, message = MISTAKES[mistake]
    text = (home / "listed.py").read_text()
    where = text.index("class Shape") if '"' in right or ")," in right else text.index("def forward")
    assert right in text[where:]
    (home / "listed.py").write_text(text[:where] + text[where:].replace(right, wrong, 1))
    with pytest.raises(ConfigError, match=message):
        make()


def test_a_term_without_a_gradient_is_warned_of_unless_it_says_so(home: Path) -> None:
    path = home / "listed.py"
    cut = path.read_text().replace("    return state.qvel[:, 0]\n", "    return state.qvel[:, 0].detach()\n")
    path.write_text(cut)
    with pytest.warns(UserWarning, match="reward_terms of Listed: forward has no .* write gradient=False in its Term"):
        make(differentiable=True)


class SpinReward(AntReward):
    spin: float = 0.5


class SpinSettings(AntSettings):
    reward: SpinReward = SpinReward()


class PlainAnt(Ant):
    """Appends a part to the terms of the ant by the plain methods."""

    Settings = SpinSettings
    reward_names = (*Ant.reward_names, "spin")

    def reward_terms(self, state, action, obs):
        spin = -self.config.reward.spin * state.qvel[:, 5].square()
        return torch.cat((super().reward_terms(state, action, obs), spin[:, None]), dim=-1)


def test_plain_methods_may_add_to_terms() -> None:
    settings: EnvSettings = SpinSettings(name=f"{__name__}:PlainAnt", reward=SpinReward(joint_limit=0.1))
    env = PlainAnt(settings, parse_config({"env": {"name": "ant"}}).physics, 2, "cpu", 0, None)
    assert env.reward_names == (*Ant.reward_names, "joint_limit", "spin")
    state = env.state.physics._replace(qvel=torch.full((2, 14), 2.0))
    action = torch.zeros(2, 8)
    terms = env.reward_terms(state, action, env.observe(state, action))
    assert terms.shape == (2, 7)
    assert terms[:, -1].tolist() == [-2.0, -2.0]


def test_the_name_of_a_weight_is_that_of_its_term_unless_it_says_another() -> None:
    assert (Term("up", 1.0).setting, Term("up", 1.0, setting="up_weight").setting) == ("up", "up_weight")
