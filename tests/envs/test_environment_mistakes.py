"""What users get wrong in a class of their own: each mistake is one line that names the method and what to write."""

import math
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from walkers import MISTAKES, Mistake, write

from msk_ray.cli import run as run_command
from msk_ray.config import dump_yaml, parse_config
from msk_ray.envs import Env, make_env
from msk_ray.errors import ConfigError, Failure, SimulationError
from msk_ray.train import main
from msk_ray.training import Trainer
from msk_ray.training.evaluation import Evaluator

TRIAL: dict[str, Any] = {
    "env": {"name": "walker:Walker", "nworld": 4, "episode_length": 6},
    "shac": {"horizon": 4, "critic_batches": 1, "critic_iterations": 1},
    "actor": {"hidden": [8]},
    "critic": {"hidden": [8]},
    "evaluation": {"nworld": 2, "interval": 2},
    "trial": {"epochs": 2},
    "execution": {"loggers": []},
}


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder in which `walker.py` lies."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # two files of one size within a second would be one
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("walker", None)


def make(differentiable: bool = True, **settings: Any) -> Env[Any]:
    config = parse_config(TRIAL | {"env": TRIAL["env"] | settings})
    return make_env(config.env, config.physics, 4, "cpu", 0, differentiable=differentiable)


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=list(MISTAKES))
def test_each_mistake_is_one_line_that_says_what_to_write(home: Path, mistake: Mistake) -> None:
    write(home, mistake)
    with pytest.raises(ConfigError, match=mistake.message) as caught:
        make()
    message = str(caught.value)
    assert "\n" not in message
    for line in re.findall(r"walker\.py:(\d+)", message):
        wrong = (home / "walker.py").read_text().splitlines()[int(line) - 1]
        assert not mistake.wrong or wrong.strip() in mistake.wrong


@pytest.mark.parametrize(
    "name", ["reward in float64", "state written in observe", "noise of torch", "exception in fell"]
)
def test_a_command_ends_with_that_line(home: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    write(home, MISTAKES[name])
    (home / "walker.yaml").write_text(dump_yaml(TRIAL))
    assert run_command(main, ["--config", "walker.yaml", "--device", "cpu"]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith("error: ")
    assert not list(home.rglob("metrics.jsonl"))


def test_a_sound_class_is_made_without_a_word_and_as_if_it_had_not_been_tried(home: Path) -> None:
    noisy = ("return torch.cat((state.qpos, self.scale * state.qvel), -1)", "return state.qpos + self.normal(4, 1)")
    write(home, noisy)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make()
    assert env.obs_size == 1
    generator = torch.Generator().manual_seed(0)
    start = env.draw_physics(4)
    env.generator = generator
    assert torch.equal(env.draw_physics(4).qpos, env.state.physics.qpos)
    env.draw_physics(4)
    env.generator.manual_seed(0)
    env.draw_physics(4)
    assert torch.equal(env.draw_physics(4).qpos, start.qpos), "trying the methods has drawn numbers"


CUT = ("forward = self.config.reward.forward * state.qvel[:, 0]", "forward = state.qvel[:, 0].detach()")


def test_a_term_that_can_have_no_gradient_is_named_once_where_one_is_wanted(home: Path) -> None:
    write(home, CUT)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        make(differentiable=False)
        assert not seen
        env = make()
        for _ in range(2):
            env.step(torch.zeros(4, 1, requires_grad=True))
    (warning,) = seen
    assert "reward_terms of Walker: forward has no gradient to the state or the action" in str(warning.message)
    assert "write without_gradient = ('forward',) in the class" in str(warning.message)


def test_a_term_that_is_meant_to_have_no_gradient_is_not_named(home: Path) -> None:
    write(home, CUT, ("    reward_names", "    without_gradient = ('forward',)\n    reward_names"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make()


LATE = {
    "width": (
        "return torch.cat((state.qpos, self.scale * state.qvel), -1)",
        "return torch.cat((state.qpos, state.qvel), -1)[:, : 1 + int(self.state.age.max() < 3)]",
        "observe of Walker has 1 entries, but 2 before",
    ),
    "type": (
        "return torch.stack((forward, effort), -1)",
        "return torch.stack((forward, effort), -1).to(torch.float64 if self.state.age.max() > 1 else torch.float32)",
        "reward_terms of Walker returns torch.float64",
    ),
    "place": (
        "return state.qpos[:, 0] > 3.0",
        "return (state.qpos.add_(1.0) if self.state.age.max() > 1 else state.qpos)[:, 0] > 3.0",
        r"observe, reward_terms or fell of Walker changes state\.qpos in place",
    ),
}


@pytest.mark.parametrize(("sound", "wrong", "message"), LATE.values(), ids=list(LATE))
def test_what_goes_wrong_later_is_said_too(home: Path, sound: str, wrong: str, message: str) -> None:
    write(home, (sound, wrong))
    env = make()

    def run() -> None:
        for _ in range(4):
            env.step(torch.zeros(4, 1))

    with torch.no_grad(), pytest.raises(ConfigError, match=message):
        run()


@pytest.mark.parametrize("algorithm", ["shac", "ppo"])
@pytest.mark.parametrize(
    ("sound", "wrong", "message"),
    [
        (
            "effort = -action.square().mean(-1)",
            "effort = torch.where(self.state.age + self._worlds == 4, math.nan, -action.square().mean(-1))",
            r"nonfinite_reward: term 'effort' of reward_terms is nan in world 3 at env step 2 of epoch 1;",
        ),
        (
            "return torch.cat((state.qpos, self.scale * state.qvel), -1)",
            "bad = torch.where(self.state.age + self._worlds == 4, math.inf, 0.0)[:, None]\n"
            "        return torch.cat((state.qpos, state.qvel + bad), -1)",
            r"nonfinite_observation: entry 1 of observe is inf in world 3 before env step 2 of epoch 1;",
        ),
    ],
    ids=["reward", "observation"],
)
def test_nan_is_found_by_term_world_and_step(home: Path, algorithm: str, sound: str, wrong: str, message: str) -> None:
    """World w is wrong once its episode is 4 - w steps old."""
    write(
        home,
        (sound, wrong),
        ("import random\n", "import math\nimport random\n"),
        ("self.scale =", "self._worlds = torch.arange(self.nworld, device=self.device)\n        self.scale ="),
    )
    own = {"ppo": {"steps": 4}, "algorithm": {"name": "ppo"}} if algorithm == "ppo" else {}
    evaluation = TRIAL["evaluation"] | {"steps": 1}
    trainer = Trainer(parse_config(TRIAL | own | {"evaluation": evaluation}), home / "trial", "cpu")
    with pytest.raises(SimulationError, match=message) as caught:
        trainer.run_epoch()
    trainer.close()
    assert caught.value.failure is Failure.NONFINITE
    assert "contacts" not in str(caught.value)


def scores(policies: int) -> list[float]:
    evaluator = Evaluator(parse_config(TRIAL), "cpu", policies=policies)
    return [figures["score"] for figures in evaluator.run([lambda obs: torch.tanh(obs[:, :1])] * policies)]


def test_noise_of_the_environments_generator_repeats_for_each_policy(home: Path) -> None:
    write(home, ("self.scale * state.qvel)", "state.qvel + self.normal(self.nworld, 1))"))
    first, second = scores(1), scores(2)
    assert second == first * 2
    assert math.isfinite(first[0])


def test_an_evaluation_that_draws_from_another_generator_says_so(home: Path) -> None:
    """Not in the first steps, which are tried when the environment is made."""
    later = "state.qvel + (self.state.age.max() > 2 and torch.randn(1)))"
    write(home, ("self.scale * state.qvel)", later))
    with pytest.warns(
        UserWarning, match="the evaluation drew from torch's global generator, so its score does not rep"
    ):
        scores(1)


def test_an_observation_belongs_to_the_age_reached(home: Path) -> None:
    """A command that changes within an episode is the same in what a step gives as in the state that it leads to."""
    write(home, ("self.scale * state.qvel)", "torch.sin(self.state.age)[:, None])"))
    env = make(episode_length=3)
    env.spread_ages()
    ages = []
    for _ in range(4):
        before = env.state.age
        transition = env.step(torch.zeros(4, 1))
        reached = before + 1
        assert torch.equal(transition.obs[:, 1], torch.sin(reached))
        assert torch.equal(env.observation()[:, 1], torch.sin(env.state.age))
        going = env.state.age > 0
        assert torch.equal(transition.obs[going], env.observation()[going])
        ages.append(going)
    assert any(going.any() for going in ages)
    assert not all(going.all() for going in ages), "no episode has ended"
