"""Read configurations: from YAML to a checked `Config`, or one line that says what to write instead."""

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from msk_ray.config.algorithms import BUILT_IN, settings_from_outside
from msk_ray.config.environments import settings_class
from msk_ray.config.faults import describe_fault
from msk_ray.config.horizons import horizon_class
from msk_ray.config.overlay import leaves, merge, overlay, parse_overrides
from msk_ray.config.recorded import current_settings, env_name
from msk_ray.config.schema import Config
from msk_ray.config.sections import SHOWN
from msk_ray.config.yaml_text import read_yaml
from msk_ray.errors import ConfigError, brief, shortened
from msk_ray.shipped import CONFIGS, find_shipped, is_name, shipped_names


def parse_config(data: Mapping[str, Any], source: str = "config") -> Config:
    """Check nested plain data and freeze it. `source` names it in errors.

    Raises:
        ConfigError: with the first error on one line.
    """
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{source}: {describe_fault(error, named=_named(data))}") from None


def parse_recorded(data: Mapping[str, Any], source: str, *, shown: bool = False) -> Config:
    """A trial's recorded configuration, written by this version or an earlier one.

    Args:
        shown: for display only: if a class cannot be found here (`Config.undeclared`), accept its settings as recorded.

    Raises:
        ConfigError: as for `parse_config`, or a removed setting had an effect.
    """
    settings = current_settings(data) if isinstance(data, Mapping) else data
    if not shown:
        return parse_config(settings, source)
    try:
        return Config.model_validate(settings, context=SHOWN)
    except ValidationError as error:
        raise ConfigError(f"{source}: {describe_fault(error, named=_named(settings))}") from None


def read_config(path: Path) -> dict[str, Any]:
    """The settings of a config file, merged into those of the file it `extends`, if any, in the current spelling.

    `extends` is a path relative to the file, or the name of a shipped config, and only one level deep: an extended file
    may not extend another.

    Raises:
        ConfigError: as for `read_yaml`, or a chain of `extends`.
    """
    data = read_yaml(path)
    base_name = data.pop("extends", None)
    if base_name is None:
        return current_settings(data)
    base_path = find_config(base_name) if is_name(str(base_name)) else path.parent / str(base_name)
    base = read_yaml(base_path)
    if "extends" in base:
        raise ConfigError(f"{path} extends {base_path}, which extends another file: extend that one directly")
    return merge(current_settings(base), current_settings(data))


def find_config(path: str | Path) -> Path:
    """The file with this path, or of this name in `configs/` of the current folder or of the package. A path without a
    file is returned unchanged; `read_config` reports it.

    Raises:
        ConfigError: the name is unknown; the message lists the known ones.
    """
    shipped = find_shipped(path, CONFIGS, ".yaml")
    if shipped is None and is_name(path):
        known = ", ".join(shipped_names(CONFIGS, ".yaml"))
        raise ConfigError(f"unknown config {brief(str(path))}; known: {known}, or give a path to a .yaml file")
    return Path(path) if shipped is None else shipped


def load_config(path: str | Path, overrides: Iterable[str] = ()) -> Config:
    """Read a config file and apply "a.b=value" overrides to it.

    Args:
        path: a file, or the name of one in `configs/` of the current folder or of the package.

    Raises:
        ConfigError: as for `find_config`, `read_config`, `parse_override`, `parse_config` and `refuse_ignored`.
    """
    values = parse_overrides(overrides)
    config = parse_config(overlay(read_config(find_config(path)), values), str(path))
    refuse_ignored(values, [config], "--set")
    return config


def refuse_ignored(values: Mapping[str, Any], configs: Iterable[Config], source: str) -> None:
    """Refuse dotted settings that no trial's algorithm uses. `source` names them in errors.

    A config file may hold settings for other algorithms; settings given on the command line or in a space may not.

    Raises:
        ConfigError: the message names the first of them.
    """
    ignored = {config.algorithm.name: config.ignored for config in configs}
    for leaf in (leaf for key, value in values.items() for leaf, _ in leaves(key, value)):
        if ignored and all(any(f"{leaf}.".startswith(f"{key}.") for key in keys) for keys in ignored.values()):
            raise ConfigError(
                f"{source} {shortened(leaf)}: nothing reads it while algorithm.name is {' or '.join(ignored)}; "
                "leave it out"
            )


def _named(data: Any) -> dict[str, type[BaseModel]]:
    """Settings classes of the dotted sections that depend on a `name` or `kind`, where that is valid."""
    sections: dict[str, type[BaseModel]] = {}
    if not isinstance(data, Mapping):
        return sections
    with contextlib.suppress(ConfigError):  # the invalid name is reported by its own check
        sections["env"] = settings_class(env_name(data))
    algorithm = data.get("algorithm")
    name = algorithm.get("name") if isinstance(algorithm, Mapping) else None
    if isinstance(name, str) and name not in BUILT_IN:
        with contextlib.suppress(ConfigError):
            sections["algorithm.settings"] = settings_from_outside(name)
    shac = data.get("shac")
    horizon = shac.get("horizon") if isinstance(shac, Mapping) else None
    if isinstance(horizon, Mapping):
        with contextlib.suppress(ConfigError):
            sections["shac.horizon"] = horizon_class(horizon.get("kind"))
    return sections
