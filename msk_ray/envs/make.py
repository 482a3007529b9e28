"""The environment that a section of the configuration describes."""

from typing import Any

from msk_ray.config import AS_USUAL, ENVIRONMENTS, EnvSettings, ExecutionConfig, PhysicsConfig, resolve_class
from msk_ray.envs.base import Env
from msk_ray.errors import ConfigError
from msk_ray.step import Backward, FdJacobian, Hybrid, TapePerSubstep
from msk_ray.step.autograd.modes import make_backward


def env_class(config: EnvSettings) -> type[Env[Any]]:
    """The class of the environment that these settings name.

    Raises:
        ConfigError: there is no such class, it lacks a method, or has settings of another type.
    """
    path = ENVIRONMENTS.path(config.name)
    chosen: type[Env[Any]] = resolve_class(path, ENVIRONMENTS.key, Env)  # type: ignore[type-abstract]
    if not isinstance(config, chosen.Settings):
        wanted = f"{chosen.Settings.__module__}.{chosen.Settings.__qualname__}"
        raise ConfigError(f"env.name: {path} takes settings of type {wanted}, not {type(config).__qualname__}")
    return chosen


def make_env(
    config: EnvSettings,
    physics: PhysicsConfig,
    nworld: int,
    device: str,
    seed: int,
    *,
    differentiable: bool = True,
    randomize: bool = False,
    execution: ExecutionConfig = AS_USUAL,
) -> Env[Any]:
    """Build the environment of a config section.

    Args:
        config, physics: the sections.
        nworld: number of worlds.
        device: "cpu" or "cuda:N".
        seed: of initial states and of `physics.randomize`.
        differentiable: whether steps can be differentiated.
        randomize: whether `physics.randomize` applies, as in training; otherwise the model keeps its own parameters and
            nothing is disturbed.
        execution: how steps are computed.

    Raises:
        ConfigError: as for `env_class`.
        UnsupportedModelError: the model cannot be stepped, or not differentiated by `physics.backward`.
        DeviceError: no such device.
    """
    backward = configured_backward(physics) if differentiable else None
    if not randomize:
        physics = physics.model_copy(update={"randomize": None})
    return env_class(config)(config, physics, nworld, device, seed, backward, execution)


def configured_backward(physics: PhysicsConfig) -> Backward:
    """The backward mode of a physics section."""
    match physics.backward:
        case "fd_jacobian":
            return FdJacobian(**physics.fd.model_dump())
        case "hybrid":
            return Hybrid(TapePerSubstep(physics.substep_grad_clip), FdJacobian(**physics.fd.model_dump()))
        case name:
            return make_backward(name, substep_grad_clip=physics.substep_grad_clip)
