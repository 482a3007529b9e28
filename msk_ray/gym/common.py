"""Code that both interfaces share: config, spaces, seeds."""

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from msk_ray.config import Config, load_config
from msk_ray.envs import Env
from msk_ray.errors import ConfigError


def read(config: Config | str | Path) -> Config:
    """A config from a Config, a file, or a name in `configs/`.

    Raises:
        ConfigError: as for `load_config`.
    """
    return config if isinstance(config, Config) else load_config(config)


def refuse_options(options: dict[str, Any] | None) -> None:
    """Raise ConfigError if options are given to a reset, which takes none."""
    if options:
        raise ConfigError(f"reset takes no options, but got {', '.join(options)}: leave them out")


def observation_space(env: Env[Any]) -> spaces.Box:
    """Observation space of one world, (O,)."""
    return spaces.Box(-np.inf, np.inf, (env.obs_size,), np.float32)


def action_space(env: Env[Any]) -> spaces.Box:
    """Action space of one world, (A,)."""
    return spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)
