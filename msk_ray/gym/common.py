"""What both interfaces share: which environment, and its spaces."""

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from msk_ray.config import Config, load_config
from msk_ray.envs import Env
from msk_ray.errors import ConfigError


def read(config: Config | str | Path) -> Config:
    """A config, given as such, by its file, or by its name in `configs/`.

    Raises:
        ConfigError: as for `load_config`.
    """
    return config if isinstance(config, Config) else load_config(config)


def refuse_options(options: dict[str, Any] | None) -> None:
    """Raise ConfigError for options of a reset: there are none."""
    if options:
        raise ConfigError(f"reset takes no options, but got {', '.join(options)}: leave them out")


def observation_space(env: Env[Any]) -> spaces.Box:
    """Observations of one world, (O,)."""
    return spaces.Box(-np.inf, np.inf, (env.obs_size,), np.float32)


def action_space(env: Env[Any]) -> spaces.Box:
    """Actions of one world, (A,)."""
    return spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)


def seed_env(env: Env[Any], seed: int) -> None:
    """Draw initial states, and randomized parameters, from a seed."""
    env.generator.manual_seed(seed)
    if env.randomizer is not None:
        env.randomizer.seed(seed)
