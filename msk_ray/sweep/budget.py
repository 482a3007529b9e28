"""The longest possible trial of a space: the scheduler's `grace`, rungs and `interval` are shares of its length."""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from msk_ray.config import Config, env_name, leaves, overlay, parse_config
from msk_ray.config.algorithms import BUILT_IN
from msk_ray.sweep.operators import Operator
from msk_ray.sweep.rules.scheduler import refuse_several
from msk_ray.sweep.space import Space, SpaceFile
from msk_ray.sweep.trials import base_settings, check_algorithms_read, check_ranges

_DECIDING = (
    "algorithm",
    *(f"{section}.{settings.length}" for section, settings in BUILT_IN.items()),
    "trial.epochs",
    "env.nworld",
)
"""Settings and sections that determine how many env steps a trial takes."""


def env_steps_budget(config: Config) -> int:
    """The largest number of env steps that a trial can take to its last epoch.

    Raises:
        ConfigError: its algorithm does not define it.
    """
    return config.algorithm_settings.env_steps(config.env.nworld, config.trial.epochs)


def longest_budget(file: SpaceFile, configs: Iterable[Config]) -> float:
    """The largest budget of some trials, in the scheduler's unit of time.

    Args:
        file: the space, with its scheduler.
        configs: the trials' configs; for a search, whose trials are not known yet, `extreme_configs`.
    """
    attribute = file.scheduler.time_attr
    if attribute == "env_steps":
        return max(env_steps_budget(config) for config in configs)
    if attribute == "epoch":
        return max(config.trial.epochs for config in configs)
    return file.stop.wall_time_s.seconds if file.stop.wall_time_s is not None else 0.0


def extreme_configs(space: Space) -> list[Config]:
    """Configs among which is the longest one that a search can suggest: all combinations of parameters that change the
    length.

    A trial's length is monotonic in each number, so the two ends of a range are enough. Other parameters have their
    first level or lower end.

    Raises:
        ConfigError: the base, an end of a range or a combination is not a valid config, or trials would run in
            several environments.
    """
    base = base_settings(space)
    check_ranges(space, base)
    _refuse_several_environments(space, base)
    configs = list(_combinations(space, base))
    check_algorithms_read(space, configs)
    return configs


def _refuse_several_environments(space: Space, base: Mapping[str, Any]) -> None:
    for key, op in space.sampled.items():
        names = [env_name(overlay(base, {key: level.value})) or "" for level in op.extremes()]
        refuse_several(names, f"{space.name}: search: {space.file.search} learns from the scores of all trials")


def _combinations(space: Space, base: Mapping[str, Any]) -> Iterator[Config]:
    choices = [op.extremes() if _decides(key, op) else op.extremes()[:1] for key, op in space.sampled.items()]
    for levels in itertools.product(*choices):
        chosen = dict(zip(space.sampled, levels, strict=True))
        name = ", ".join(f"{key} {level.label}" for key, level in chosen.items())
        settings = overlay(base, {key: level.value for key, level in chosen.items()})
        yield parse_config(settings, f"{space.name}: {name}")


def _decides(key: str, op: Operator) -> bool:
    """Whether a parameter affects the length of a trial."""
    touched = (leaf for level in op.extremes() for leaf, _ in leaves(key, level.value))
    return any(leaf == known or leaf.startswith(f"{known}.") for leaf in touched for known in _DECIDING)
