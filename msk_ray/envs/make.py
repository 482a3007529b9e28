"""The environment that a section of the configuration describes."""

from typing import Any

from msk_ray.config import ENVIRONMENTS, EnvSettings, PhysicsConfig, resolve_class
from msk_ray.envs.base import Env
from msk_ray.errors import ConfigError
from msk_ray.step.autograd.modes import configured_backward


def env_class(config: EnvSettings) -> type[Env[Any]]:
    """The class of the environment that these settings name.

    Raises:
        ConfigError: there is no such class, it lacks a method, or has settings of another type.
    """
    path = ENVIRONMENTS.path(config.name)
    found: type[Env[Any]] = resolve_class(path, ENVIRONMENTS.key, Env)  # type: ignore[type-abstract]
    if not isinstance(config, found.Settings):
        wanted = f"{found.Settings.__module__}.{found.Settings.__qualname__}"
        raise ConfigError(f"env.name: {path} takes settings of type {wanted}, not {type(config).__qualname__}")
    return found


def make_env(
    config: EnvSettings,
    physics: PhysicsConfig,
    nworld: int,
    device: str,
    seed: int,
    *,
    differentiable: bool = True,
    randomize: bool = False,
    deterministic: bool = False,
) -> Env[Any]:
    """Build the environment of a config section.

    Args:
        config, physics: the sections.
        nworld: number of worlds.
        device: "cpu" or "cuda:N".
        seed: of initial states and of randomized parameters.
        differentiable: whether steps can be differentiated.
        randomize: whether `physics.randomize` applies, as in training; otherwise the model keeps its own parameters.
        deterministic: whether sums of the physics have a fixed order.

    Raises:
        ConfigError: as for `env_class`.
        UnsupportedModelError: the model cannot be stepped, or not differentiated by `physics.backward`.
        DeviceError: no such device.
    """
    backward = configured_backward(physics) if differentiable else None
    if not randomize:
        physics = physics.model_copy(update={"randomize": None})
    return env_class(config)(config, physics.in_order(deterministic), nworld, device, seed, backward)
