"""Exported policies remember what their environment does, without it."""

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor, nn

from msk_ray.config import PhysicsConfig
from msk_ray.envs import make_env
from msk_ray.envs.cartpole.config import CartPoleSettings
from msk_ray.envs.cartpole.env import CartPole
from msk_ray.envs.memory import Memory
from msk_ray.errors import ExportError
from msk_ray.export import network
from msk_ray.export.compare import difference_over_steps, largest_difference, observations
from msk_ray.export.network import PolicyToControl
from msk_ray.step import StepState

pytestmark = pytest.mark.long


class Filtered(CartPole):
    """A cart with a slow motor, a delayed action, and a history of two angles that it observes; its rewards count
    steps."""

    def memories(self) -> Mapping[str, Memory]:
        return {
            "force": Memory(1, start=0.25),
            "delayed": Memory(1),
            "angles": Memory(2),
            "steps": Memory(1),
            "height": Memory(1),
        }

    def remember(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        before = self.state.physics.qpos
        return {
            "force": self.control(action),
            "delayed": action,
            "angles": torch.cat((self.memory["angles"][:, 1:], torch.cos(before[:, 1:])), -1),
            "steps": self.memory["steps"] + 1.0,
            "height": torch.cos(state.qpos[:, 1:]).square(),
        }

    def control(self, action: Tensor) -> Tensor:
        return 0.5 * self.memory["force"] + 0.3 * self.memory["delayed"] + 0.2 * action

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        obs = super().observe(state, action)
        shown = torch.cat((2.0 * self.memory["force"], self.memory["angles"]), -1)
        return torch.cat((shown, obs, self.memory["height"]), -1)


class Held(Filtered):
    """Its motor's law is no matrix product."""

    def control(self, action: Tensor) -> Tensor:
        return torch.maximum(action, self.memory["force"])


class TwoActions(CartPole):
    """It observes its last two actions."""

    def memories(self) -> Mapping[str, Memory]:
        return {"older": Memory(1)}

    def remember(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        return {"older": self.state.action}

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return torch.cat((super().observe(state, action), action, self.memory["older"]), -1)


def made(kind: type[CartPole]) -> tuple[CartPole, PolicyToControl]:
    settings = CartPoleSettings(name="cartpole")
    env = kind(settings, PhysicsConfig(), 4, "cpu", 0, None)
    layers = nn.Sequential(nn.Linear(env.obs_size, 8), nn.Tanh(), nn.Linear(8, 1), nn.Tanh())
    generator = torch.Generator().manual_seed(0)
    for parameter in layers.parameters():
        nn.init.normal_(parameter, std=0.5, generator=generator)
    return env, PolicyToControl(layers, env).eval().requires_grad_(False)


def test_what_it_can_carry_is_inside_and_the_rest_is_given() -> None:
    env, policy = made(Filtered)
    assert policy.inputs == ["obs", "memory_force", "memory_delayed", "memory_angles"]
    assert policy.outputs == ["action", "ctrl", "next_memory_force", "next_memory_delayed", "next_memory_angles"]
    assert policy.memory.shown == [0, 1, 2]
    assert policy.memory.given == [3, 4, 5, 6, 7, 8]
    assert [each.start.tolist() for each in policy.carried] == [[0.25], [0.0], [0.0, 0.0]]
    assert policy.remarks == [
        "entries of obs show 'height', which the file cannot carry: your program has to keep it and pass these entries"
    ]
    assert not env.measurements.ignore_contact_forces
    inputs = policy.examples(observations(env, 0), 0)
    for write in (network.to_onnx, network.to_torchscript):
        run = write(policy, *inputs)[1]
        assert largest_difference(policy, run, *inputs) <= 1e-5
        assert difference_over_steps(policy, run, env) <= 1e-5


def test_a_wrong_memory_is_found_over_steps() -> None:
    env, policy = made(Filtered)

    def run(*inputs: Tensor) -> list[Tensor]:
        action, ctrl, force, *others = policy(*inputs)
        return [action, ctrl, force + 1e-3, *others]

    with pytest.raises(ExportError, match=r"its action differs from the checkpoint's by .* in step 2 of an episode"):
        difference_over_steps(policy, run, env)


def test_a_memory_that_is_no_matrix_product_is_given_and_controls_that_need_it_are_left_out() -> None:
    _, policy = made(Held)
    assert policy.outputs == ["action", "next_memory_angles"]
    assert policy.inputs == ["obs", "memory_angles"]
    assert policy.memory.given == [0, 3, 4, 5, 6, 7, 8]
    assert policy.remarks == [
        "no ctrl: `control` reads 'force', which the file cannot carry",
        "entries of obs show 'force' and 'height', which the file cannot carry: your program has to keep it and pass "
        "these entries",
    ]


def test_a_history_of_the_action_that_is_observed_is_carried() -> None:
    env, policy = made(TwoActions)
    assert policy.inputs == ["obs", "memory_older"]
    assert policy.memory.given == [0, 1, 2, 3, 4, 5]
    assert difference_over_steps(policy, lambda *inputs: list(policy(*inputs)), env) <= 1e-5


def test_without_memory_nothing_is_carried() -> None:
    env = make_env(CartPoleSettings(name="cartpole"), PhysicsConfig(), 4, "cpu", 0, differentiable=False)
    policy = PolicyToControl(nn.Linear(5, 1), env)
    assert not policy.memory.start
    assert policy.inputs == ["obs"]
    obs = torch.randn(3, 5)
    assert torch.equal(policy.given(obs), obs)
