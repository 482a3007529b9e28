"""The environments that `env.name` can take, and the settings that each declares."""

import difflib
from typing import Any

from msk_ray.config.physics import PhysicsConfig
from msk_ray.config.sections import EnvSettings, Reward, Undeclared
from msk_ray.errors import ConfigError
from msk_ray.registry import Registry, resolve, resolve_class

ENVIRONMENTS = Registry(
    "env.name",
    "msk_ray.envs",
    {
        "cartpole": "msk_ray.envs.cartpole.env:CartPole",
        "ant": "msk_ray.envs.ant.env:Ant",
        "hopper": "msk_ray.envs.hopper.env:Hopper",
        "cheetah": "msk_ray.envs.cheetah.env:Cheetah",
        "humanoid": "msk_ray.envs.humanoid.env:Humanoid",
    },
)
"""Classes of environments."""
SETTINGS = Registry(
    "env.name",
    "msk_ray.env_settings",
    {
        "cartpole": "msk_ray.envs.cartpole.config:CartPoleSettings",
        "ant": "msk_ray.envs.ant.config:AntSettings",
        "hopper": "msk_ray.envs.hopper.config:HopperSettings",
        "cheetah": "msk_ray.envs.cheetah.config:CheetahSettings",
        "humanoid": "msk_ray.envs.humanoid.config:HumanoidSettings",
    },
)
"""Settings that can be imported without their environment, which loads torch. For other names, the environment's class
is asked."""


class UndeclaredReward(Reward, Undeclared):
    """A reward section with any settings."""


class UndeclaredEnv(EnvSettings, Undeclared):
    """Recorded settings of an environment whose class is not installed here."""

    reads_physics = frozenset(PhysicsConfig.names())

    reward: UndeclaredReward = UndeclaredReward()


def settings_class(name: Any) -> type[EnvSettings]:
    """The settings class of the environment with this name or import path.

    Raises:
        ConfigError: there is no such environment, or its settings class is incomplete.
    """
    path = ENVIRONMENTS.path(name)
    light = SETTINGS.find(name)
    if light is not None:
        settings = resolve_class(light, ENVIRONMENTS.key, EnvSettings)
    else:
        declared = getattr(resolve(path, ENVIRONMENTS.key), "Settings", None)
        if not (isinstance(declared, type) and issubclass(declared, EnvSettings)):
            raise ConfigError(f"env.name: {path} declares no settings: write `class Settings(EnvSettings)` in it")
        settings = declared
    _check_declared(settings, path)
    return settings


def _check_declared(settings: type[EnvSettings], path: str) -> None:
    reads = getattr(settings, "reads_physics", None)
    if reads is None:
        raise ConfigError(
            f"env.name: the settings of {path} do not declare which physics settings they read: write "
            "`reads_physics = STEPPING | SOLVING` (msk_ray.config.physics)"
        )
    known = PhysicsConfig.names()
    for name in sorted(set(reads) - set(known)):
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"write some of {', '.join(known)}"
        raise ConfigError(f"env.name: the settings of {path} read physics.{name}, which does not exist; {hint}")
    reward = settings.model_fields["reward"].annotation
    needed = [name for name, field in getattr(reward, "model_fields", {}).items() if field.is_required()]
    if needed:
        raise ConfigError(
            f"env.name: reward.{needed[0]} of {path} has no default: policies are scored under the reward's defaults"
        )
