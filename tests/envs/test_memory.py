"""What worlds remember: reset with its world, in checkpoints and recordings, with its gradient or without."""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from msk_ray import Memory, MjcfEnv, StepState, Term
from msk_ray.algorithms.shac.actor_update import EpochInputs
from msk_ray.config import Config, parse_config
from msk_ray.diagnose.probe import Subject, probe
from msk_ray.envs import Env, make_env
from msk_ray.errors import CheckpointError
from msk_ray.group import Group
from msk_ray.step.autograd.capture import fill
from msk_ray.training import Trainer
from msk_ray.training.evaluation import Evaluator

INERTIA = 0.6


def pull(env: Any, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """The smoothed action after the step, and a tenth of how far it has moved."""
    after, before = env.next_memory["smoothed"], env.memory["smoothed"]
    return (after + 0.1 * (after - before))[:, 0]


class Rod(MjcfEnv[Any]):
    """A rod whose motor takes a while, and that counts its steps."""

    mjcf = """<mujoco><option timestep=".01"/><worldbody><body><joint name="turn" axis="0 1 0" damping=".1"/>
      <geom size=".05" fromto="0 0 0 0 0 -.5" type="capsule"/></body></worldbody>
      <actuator><motor joint="turn" ctrlrange="-1 1"/></actuator></mujoco>"""
    terms = (Term("pull", 1.0, pull),)
    gradient = True

    def memories(self) -> Mapping[str, Memory]:
        return {"smoothed": Memory(1, gradient=self.gradient), "steps": Memory(2, start=0.5), "start": Memory(1)}

    def begin_memory(self, state: StepState) -> Mapping[str, Tensor]:
        assert torch.equal(state.qpos, self.state.physics.qpos)
        assert bool((self.memory["steps"] == 0.5).all())
        return {"start": state.qpos}

    def remember(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        return {
            "start": self.memory["start"],
            "steps": self.memory["steps"] + 1.0,
            "smoothed": self.control(action),
        }

    def control(self, action: Tensor) -> Tensor:
        return INERTIA * self.memory["smoothed"] + (1.0 - INERTIA) * action

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return torch.cat((state.qpos, state.qvel, *self.memory.values(), 0.01 * self.state.age[:, None]), -1)

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        return {"smoothed": self.memory["smoothed"][:, 0]}


class Detached(Rod):
    """The same without a gradient from step to step."""

    gradient = False


TRIAL: dict[str, Any] = {
    "env": {"name": f"{__name__}:Rod", "nworld": 4, "episode_length": 5},
    "shac": {"horizon": 4, "critic_batches": 1, "critic_iterations": 1},
    "actor": {"hidden": [8]},
    "critic": {"hidden": [8]},
    "evaluation": {"nworld": 2, "interval": 2, "steps": 40},
    "trial": {"epochs": 2},
    "execution": {"loggers": []},
}


def trial(name: str = "Rod", **env: Any) -> Config:
    return parse_config(TRIAL | {"env": TRIAL["env"] | {"name": f"{__name__}:{name}"} | env})


def rod(name: str = "Rod") -> Env[Any]:
    config = trial(name)
    return make_env(config.env, config.physics, 4, "cpu", 0)


def test_memory_lasts_until_the_episode_ends_and_observations_show_the_new_memory() -> None:
    env = rod()
    env.spread_ages()
    every = []
    for _ in range(5):
        before = env.memory
        action = env.uniform(4, 1)
        transition = env.step(action)
        going, after = env.state.age > 0, env.memory
        assert torch.equal(after["steps"], torch.where(going[:, None], before["steps"] + 1.0, 0.5))
        smoothed = INERTIA * before["smoothed"] + (1.0 - INERTIA) * action
        assert torch.equal(after["smoothed"], torch.where(going[:, None], smoothed, 0.0))
        assert torch.equal(after["start"][~going], env.state.physics.qpos[~going])
        assert torch.equal(after["start"][going], before["start"][going])
        assert torch.equal(transition.obs[going], env.observation()[going])
        every.append(going)
    assert {True, False} == set(torch.cat(every).tolist())


@pytest.mark.parametrize(
    ("name", "slope"), [("Rod", (1.0 - INERTIA) * (INERTIA + 0.1 * (INERTIA - 1.0))), ("Detached", 0.0)]
)
def test_gradients_flow_through_memory_between_steps_only_if_declared(name: str, slope: float) -> None:
    """Within a step it always has one: the reward depends on the action through the memory alone."""
    env = rod(name)
    first, second = (torch.zeros(4, 1, requires_grad=True) for _ in range(2))
    env.step(first)
    reward = env.step(second).reward.sum()
    to_first, to_second = torch.autograd.grad(reward, (first, second), allow_unused=True)
    assert to_second == pytest.approx(torch.full((4, 1), 1.1 * (1.0 - INERTIA)))
    assert (0.0 if to_first is None else to_first) == pytest.approx(torch.full((4, 1), slope) if slope else 0.0)


def test_the_gradient_of_a_policy_with_memory_matches_finite_differences() -> None:
    (quality,) = probe(Subject(trial(), None), [None], ["reset"], [4], worlds=1, directions=2, seed=0, device="cpu")
    assert quality.cosine == pytest.approx(1.0, abs=1e-4)
    assert quality.norm_ratio == pytest.approx(1.0, abs=1e-3)


def test_a_checkpoint_restores_memory(tmp_path: Path) -> None:
    first, second = (Trainer(trial(), tmp_path / name, "cpu") for name in "ab")
    first.run_epoch()
    saved = copy.deepcopy(first.algorithm.state_dict())
    assert saved["env_memory"]["smoothed"].any()
    second.algorithm.load_state_dict(saved)
    for trainer in (first, second):
        trainer.algorithm.run_epoch(1)
    assert first.algorithm.parameter_hash() == second.algorithm.parameter_hash()
    for name, values in first.algorithm.env.memory.items():
        assert torch.equal(values, second.algorithm.env.memory[name])
    # One of before it was declared begins with its start values.
    del saved["env_memory"]
    second.algorithm.load_state_dict(saved)
    env = second.algorithm.env
    assert torch.equal(env.memory["start"], env.state.physics.qpos)
    assert bool((env.memory["steps"] == 0.5).all())
    with pytest.raises(CheckpointError, match="has a memory 'steps' of 3 numbers, and its environment one of 2"):
        second.algorithm.load_state_dict(saved | {"env_memory": {"steps": torch.zeros(4, 3)}})
    for trainer in (first, second):
        trainer.close()


class Second(Group):
    """The second of two processes, the first of which has the same worlds."""

    rank, size = 1, 2

    def gather(self, part: Tensor, dim: int = 0) -> Tensor:
        return torch.cat((part, part), dim)

    def own(self, whole: Tensor, dim: int = 0) -> Tensor:
        return whole.chunk(2, dim)[1]

    def collect(self, value: Any) -> list[Any]:
        return [value, value]


def test_a_checkpoint_of_a_group_has_the_memory_of_all_worlds() -> None:
    env = rod()
    env.join(Second())
    env.step(torch.linspace(-1.0, 1.0, 4)[:, None])
    saved, memory = env.state_dict(), env.memory
    assert saved["env_memory"]["smoothed"].shape == (8, 1)
    env.step(torch.zeros(4, 1))
    env.load_state_dict(saved)
    assert all(torch.equal(env.memory[name], values.detach()) for name, values in memory.items())


def test_recorded_epochs_read_and_write_memory() -> None:
    """The inputs of a recorded epoch are copies of everything that a rollout begins with."""
    env = rod()
    inputs = EpochInputs(env.state.detach(), env.starts.draw_steps(2, env.group), torch.zeros(2, 4, 1))
    copies = inputs.copies()
    given = {id(t) for t in inputs.tensors()}
    assert {id(t) for t in env.state.memory.values()} & given == set(), "detached"
    env.step(torch.ones(4, 1))
    fill(copies.tensors(), EpochInputs(env.state.detach(), *inputs[1:]).tensors())
    assert torch.equal(copies.state.memory["smoothed"], env.memory["smoothed"])
    assert torch.equal(copies.state.memory["steps"], torch.full((4, 2), 1.5))
    assert torch.equal(inputs.state.memory["steps"], torch.full((4, 2), 0.5))


def test_an_evaluation_begins_with_start_values_and_scores_its_outcomes() -> None:
    evaluator = Evaluator(trial(), "cpu", policies=2)
    one, other = evaluator.run([lambda obs: torch.ones(len(obs), 1), lambda obs: 0.0 * obs[:, :1]])
    # The smoothed action after step t is 1 - INERTIA**t.
    assert one["smoothed"] == pytest.approx(1.0 - sum(INERTIA**t for t in range(1, 41)) / 40, rel=1e-5)
    assert other["smoothed"] == 0.0
    assert evaluator.run([lambda obs: torch.ones(len(obs), 1)])[0] == one


def test_an_environment_without_memories_keeps_nothing() -> None:
    config = parse_config({"env": {"name": "cartpole", "nworld": 2}})
    env = make_env(config.env, config.physics, 2, "cpu", 0)
    env.step(torch.zeros(2, 1))
    assert not env.memory
    assert len(env.state.tensors()) == 6
    assert "env_memory" not in env.state_dict()
