"""Environments: observation and reward as torch functions of (qpos, qvel, act), so that both stay in the graph.

Names are loaded when they are first asked for, so that an environment's settings can be read without torch and Warp.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msk_ray.envs.base import Env as Env
    from msk_ray.envs.make import env_class as env_class
    from msk_ray.envs.make import make_env as make_env
    from msk_ray.envs.memory import Memory as Memory
    from msk_ray.envs.mjcf.config import MjcfSettings as MjcfSettings
    from msk_ray.envs.mjcf.env import MjcfEnv as MjcfEnv
    from msk_ray.envs.records import EnvState as EnvState
    from msk_ray.envs.records import Resets as Resets
    from msk_ray.envs.records import Transition as Transition

_HOMES = {
    "Env": "msk_ray.envs.base",
    "EnvState": "msk_ray.envs.records",
    "Memory": "msk_ray.envs.memory",
    "MjcfEnv": "msk_ray.envs.mjcf.env",
    "MjcfSettings": "msk_ray.envs.mjcf.config",
    "Resets": "msk_ray.envs.records",
    "Transition": "msk_ray.envs.records",
    "env_class": "msk_ray.envs.make",
    "make_env": "msk_ray.envs.make",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'msk_ray.envs' has no attribute {name!r}; it has {', '.join(__all__)}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
