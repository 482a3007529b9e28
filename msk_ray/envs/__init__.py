"""Environments: observation and reward as torch functions of (qpos, qvel, act), so that both stay in the graph."""

from typing import Any

from msk_ray.config import EnvConfig, EnvSettings, PhysicsConfig
from msk_ray.envs.ant import Ant
from msk_ray.envs.base import Env, EnvState, Transition
from msk_ray.envs.cartpole import CartPole
from msk_ray.envs.myoleg import MyoLeg
from msk_ray.envs.myoleg26 import MyoLeg26
from msk_ray.simulation.modes import configured_backward

__all__ = ["Ant", "CartPole", "Env", "EnvState", "MyoLeg", "MyoLeg26", "Transition", "env_class", "make_env"]


_ENVS: dict[type[EnvSettings], type[Env[Any]]] = {env.settings: env for env in (CartPole, Ant, MyoLeg26, MyoLeg)}


def env_class(config: EnvConfig) -> type[Env[Any]]:
    """The environment that settings of this type describe."""
    return _ENVS[type(config)]


def make_env(
    config: EnvConfig, physics: PhysicsConfig, nworld: int, device: str, seed: int, *, differentiable: bool = True
) -> Env[Any]:
    """Build the environment of a config section.

    Raises:
        UnsupportedModelError: the model cannot be stepped, or not differentiated by `physics.backward`.
        DeviceError: no such device.
    """
    backward = configured_backward(physics) if differentiable else None
    return env_class(config)(config, physics, nworld, device, seed, backward)
