"""An env step that a CUDA graph can record: the host waits for no value, and makes no tensor of its own."""

import inspect
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from disturbed import DISTURBANCES
from torch.utils._python_dispatch import TorchDispatchMode

from msk_ray.config import parse_config
from msk_ray.envs import make_env

_LEG_TERMS = (
    *("metabolic", "head", "impact", "footfall", "clearance", "toes", "vault", "out_of_plane", "track"),
    *("track_rate", "landing"),
)
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "ant": {"name": "ant"},
    "hopper": {"name": "hopper"},
    "memory": {"name": "remembering:Remembering"},
    "go1": {"name": "go1_velocity"},
    "g1": {"name": "g1_velocity"},
    "tracking": {
        "name": "g1_tracking",
        "action_about": "reference",
        "layout": "no_state_estimation",
        "future_frames": [2],
        "failure": "pelvis",
    },
    "disturbances": {"name": "cartpole"},
    "history": {"name": "disturbed:Recalling"},
    "legs": {
        "name": "myoleg26",
        "clock": True,
        "symmetric": True,
        "reset": "cycle",
        "speed_range": [1.0, 1.5],
        "reward": dict.fromkeys(_LEG_TERMS, 0.1),
    },
}

ENCODERS = {"encoder_bias": {"*": {"uniform": 0.015}}}
RANDOMIZED = {
    "disturbances": DISTURBANCES,
    "history": DISTURBANCES,
    "go1": ENCODERS,
    "g1": ENCODERS,
    "tracking": ENCODERS,
}


def _modules_calling() -> Iterator[str]:
    frame = inspect.currentframe()
    while frame is not None:
        yield frame.f_globals.get("__name__", "")
        frame = frame.f_back


class Watch(TorchDispatchMode):
    """Notes operations that read a value on the host, or that make a tensor of Python's numbers.

    Not those of Warp: its views of arrays go through numpy on a CPU, and through nothing on a GPU.
    """

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        waits = func.overloadpacket in (torch.ops.aten._local_scalar_dense, torch.ops.aten.lift_fresh)
        if waits and not any(name.split(".")[0] == "warp" for name in _modules_calling()):
            self.seen.append(str(func))
        return func(*args, **(kwargs or {}))


def step(env: Any, action: torch.Tensor) -> None:
    env.state = env.state.detach()
    action = action + 1e-3 * env.observation().sum(-1, keepdim=True)
    transition = env.step(torch.tanh(action))
    (transition.reward.sum() + env.critic_observation_of(transition.reached).sum()).backward()


def test_the_watch_sees_an_index_without_axes_and_a_constant() -> None:
    at = torch.ones((), dtype=torch.long)
    with Watch() as watch:
        torch.zeros(3, 2)[:, at]
        torch.tensor([1.0])
    assert watch.seen == ["aten._local_scalar_dense.default", "aten.lift_fresh.default"]


@pytest.mark.parametrize("name", list(ENVIRONMENTS))
def test_nothing_waits_in_an_env_step_and_its_gradient(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """After one that has made what is made at the first use. Resets are drawn before, as for a recorded epoch.

    On a CPU the host may look at flags of worlds, and at contact forces; here it takes the way of a GPU."""
    for module in ("msk_ray.envs.base", "msk_ray.step.autograd.simulation"):
        monkeypatch.setattr(f"{module}.known_none", lambda flags: False)
    config = parse_config({"env": {**ENVIRONMENTS[name], "nworld": 2}, "physics": {"randomize": RANDOMIZED.get(name)}})
    env = make_env(config.env, config.physics, 2, "cpu", 0, randomize=True)
    env.measurements.ignore_contact_forces = True
    action = torch.zeros((2, env.action_size), requires_grad=True)
    step(env, action)
    env.starts.stock(env.starts.draw_steps(1, env.group))
    with Watch() as watch:
        step(env, action)
    assert watch.seen == []
