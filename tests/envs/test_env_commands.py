"""Commands: uniform in their ranges, drawn again in time, functions of what an episode's start has drawn."""

import copy
import pickle
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from msk_ray import Command, Config, MjcfEnv, StepState, Term
from msk_ray.config import parse_config
from msk_ray.envs import Env, make_env
from msk_ray.errors import ConfigError
from msk_ray.training import Trainer
from msk_ray.training.evaluation import Evaluator


def tracking(env: Any, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """Minus the squared error of the rate."""
    return -(state.qvel[:, 0] - env.command("pace")[:, 0]).square()


class Rod(MjcfEnv[Any]):
    """A rod that turns at a commanded pace, in a way that it keeps for an episode."""

    mjcf = """<mujoco><option timestep=".01"/><worldbody><body><joint name="turn" axis="0 1 0" damping=".1"/>
      <geom size=".05" fromto="0 0 0 0 0 -.5" type="capsule"/></body></worldbody>
      <actuator><motor joint="turn" ctrlrange="-1 1"/></actuator></mujoco>"""
    terms = (Term("tracking", 1.0, tracking),)
    commands = (
        Command("pace", {"rate": (-1.0, 3.0), "rest": (0.0, 1.0)}, every=(0.04, 0.08)),
        Command("way", {"way": (2.0, 4.0)}),
    )

    def draw_start(self, count: int) -> tuple[StepState, Tensor]:
        return self.draw_physics(count), 7.0 + self.uniform(count, 1)

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return torch.cat((state.qpos, state.qvel, self.command("pace"), self.command("way")), -1)

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        return {"rate": self.command("pace")[:, 0]}


class Widening(Rod):
    """Its range grows with every epoch."""

    begin_epoch_in_place = True

    def begin_epoch(self, epoch: int) -> None:
        self.command_ranges["pace"][1, 0] = 3.0 + epoch


TRIAL: dict[str, Any] = {
    "env": {"name": f"{__name__}:Rod", "nworld": 4, "episode_length": 20},
    "shac": {"horizon": 4, "critic_batches": 1, "critic_iterations": 1},
    "actor": {"hidden": [8]},
    "critic": {"hidden": [8]},
    "evaluation": {"nworld": 64, "interval": 2},
    "trial": {"epochs": 2},
    "execution": {"loggers": []},
}


def trial(name: str = "Rod", **env: Any) -> Config:
    return parse_config(TRIAL | {"env": TRIAL["env"] | {"name": f"{__name__}:{name}"} | env})


def rods(nworld: int = 256, **env: Any) -> Env[Any]:
    config = trial(**env)
    return make_env(config.env, config.physics, nworld, "cpu", 0)


def test_commands_are_drawn_again_within_an_episode_after_the_configured_times() -> None:
    """Every 2 to 4 of 20 steps; the last draw may be any time old."""
    env = rods()
    paces, ways = [env.command("pace")], [env.command("way")]
    for _ in range(19):
        transition = env.step(torch.zeros(256, 1))
        assert torch.equal(transition.obs, env.observation())
        paces.append(env.command("pace"))
        ways.append(env.command("way"))
    pace, way = torch.stack(paces), torch.stack(ways)
    changed = (pace[1:] != pace[:-1]).any(-1)
    assert torch.equal(changed, (pace[1:] != pace[:-1]).all(-1)), "all numbers of a command at once"
    assert bool((way == way[0]).all())
    for world in range(256):
        at = [0, *(1 + changed[:, world].nonzero()[:, 0]).tolist()]
        gaps = {later - earlier for earlier, later in pairwise(at)}
        assert gaps <= {2, 3, 4}
    low, high = pace.flatten(0, 1).aminmax(dim=0)
    assert torch.allclose(low, torch.tensor([-1.0, 0.0]), atol=0.02)
    assert torch.allclose(high, torch.tensor([3.0, 1.0]), atol=0.02)
    assert pace[..., 0].mean() == pytest.approx(1.0, abs=0.05)
    assert 2.0 <= way.min() < 2.1 < 3.9 < way.max() <= 4.0


def test_numbers_of_an_episode_are_stored_beside_commands() -> None:
    env = rods()
    task = env.task_numbers(env.state.numbers)
    assert task.shape == (256, 1)
    assert bool(((task >= 6.0) & (task < 8.0)).all())


def test_without_random_starts_commands_are_in_the_middle_of_their_ranges() -> None:
    env = rods(nworld=2, stochastic_reset=False)
    assert env.command("pace").tolist() == [[1.0, 0.5]] * 2
    assert env.command("way").tolist() == [[3.0]] * 2


def test_ranges_are_settings_and_scores_use_the_ranges_of_the_class() -> None:
    ranges = {"pace": {"rate": [5.0, 6.0], "every": [0.2, 0.2]}}
    env = rods(commands=ranges)
    assert bool(((env.command("pace")[:, 0] >= 5.0) & (env.command("pace")[:, 0] <= 6.0)).all())
    assert env.state.numbers.shape[1] == 1 + 2 * 3 + 1
    config = trial(commands=ranges)
    assert config.env.commands.pace.rate == (5.0, 6.0)
    assert pickle.loads(pickle.dumps(config.env.model_dump())) == config.env.model_dump()
    evaluators = [Evaluator(c, "cpu") for c in (config, trial())]
    (one,), (other,) = (e.run([lambda obs: 0.0 * obs[:, :1]]) for e in evaluators)
    assert one == other
    assert one["rate"] == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"pace": {"rate": [2.0, 1.0]}}, "env.commands.pace.rate: .*smaller number first"),
        ({"pace": {"every": [0.0, 1.0]}}, "env.commands.pace.every"),
        ({"pace": {"speed": [0.0, 1.0]}}, "env.commands.pace.speed"),
        ({"way": {"every": [1.0, 1.0]}}, "env.commands.way.every"),
        ({"gait": {}}, "env.commands.gait"),
    ],
)
def test_wrong_settings_are_refused(settings: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        trial(commands=settings)


def test_wrong_declarations_of_commands_are_refused() -> None:
    with pytest.raises(ValueError, match="command 'pace' needs ranges by name"):
        Command("pace", {})
    with pytest.raises(ValueError, match="none of them named 'every'"):
        Command("pace", {"every": (0.0, 1.0)})
    with pytest.raises(ValueError, match="two commands have the name 'way'"):
        type("Twice", (Rod,), {"commands": (Rod.commands[1], Rod.commands[1])})
    with pytest.raises(ConfigError, match="Rod has no command 'speed'; its commands: pace, way"):
        rods(nworld=1).command("speed")


def test_a_curriculum_widens_ranges_and_a_checkpoint_keeps_them(tmp_path: Path) -> None:
    first, second = (Trainer(trial("Widening"), tmp_path / name, "cpu") for name in "ab")
    first.run_epoch()
    first.run_epoch()
    assert first.algorithm.env.command_ranges["pace"].tolist() == [[-1.0, 0.0], [4.0, 1.0]]
    second.algorithm.load_state_dict(copy.deepcopy(first.algorithm.state_dict()))
    one, other = (trainer.algorithm.env for trainer in (first, second))
    assert torch.equal(one.observation(), other.observation())
    for trainer in (first, second):
        trainer.algorithm.run_epoch(2)
        trainer.close()
    assert torch.equal(one.command("pace"), other.command("pace"))
