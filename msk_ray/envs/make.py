"""The environment that a section of the configuration describes."""

from typing import Any

from msk_ray.config import EnvConfig, EnvSettings, PhysicsConfig
from msk_ray.envs.ant.env import Ant
from msk_ray.envs.base import Env
from msk_ray.envs.cartpole.env import CartPole
from msk_ray.envs.myoleg.env import MyoLeg
from msk_ray.envs.myoleg26.env import MyoLeg26
from msk_ray.simulation.modes import configured_backward

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
