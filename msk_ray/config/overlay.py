"""Merging settings: one rule for `--set`, `extends` and search spaces.

A mapping is merged into the existing section key by key; any other value replaces the existing one. Where a setting
accepts mappings of several kinds (by their `kind`; `env` and `algorithm` by their `name`), a mapping of another kind
replaces the old one, so that kinds never mix. `null` removes a section.
"""

import copy
from collections.abc import Iterable, Iterator, Mapping
from functools import reduce
from operator import getitem
from typing import Any

from msk_ray.config.yaml_text import MAX_DEPTH, parse_yaml
from msk_ray.errors import ConfigError, brief, shortened

SET_HELP = (
    "override a setting: KEY is dotted, VALUE is YAML. A mapping is merged into the section KEY, keeping its other "
    "settings (shac.entropy={target: 0.5} keeps coefficient), unless it is of another kind; null removes the section"
)


def parse_override(text: str) -> tuple[str, Any]:
    """Split "a.b=value" into its dotted key and its value, read as YAML.

    Raises:
        ConfigError: no "=" in it, or the value is not YAML.
    """
    key, separator, value = text.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"--set {brief(text)}: write key=value, such as shac.horizon=16")
    return key.strip(), parse_yaml(value, f"--set {shortened(text)}: the value")


def parse_overrides(texts: Iterable[str]) -> dict[str, Any]:
    """Several "a.b=value" combined in order, for `overlay`.

    Raises:
        ConfigError: as for `parse_override`.
    """
    return combine({}, [parse_override(text) for text in texts])


def combine(first: Mapping[str, Any], then: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Dotted keys and values equivalent to `first` followed by `then`.

    A key that occurs twice takes its last position, with mappings merged.
    """
    combined = dict(first)
    for key, value in then:
        old = combined.pop(key, None)
        combined[key] = _laid_over(key.split("."), old, value)
    return combined


def overlay(settings: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of nested `settings` with each dotted key of `values` set, by the rule above.

    Raises:
        ConfigError: a key goes through something that is not a section.
    """
    result = copy.deepcopy(dict(settings))
    for dotted, value in values.items():
        path = dotted.split(".")
        if len(path) > MAX_DEPTH:
            raise ConfigError(f"{shortened(dotted)}: no setting is {len(path)} sections deep")
        node = result
        for section in path[:-1]:
            if node.get(section) is None:
                node[section] = {}
            child = node[section]
            if not isinstance(child, dict):
                raise ConfigError(f"{shortened(dotted)}: {section} is a value, not a section of settings")
            node = child
        node[path[-1]] = _laid_over(path, node.get(path[-1]), value)
    return result


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`over` merged into `base`, section by section."""
    merged: dict[str, Any] = _laid_over([], dict(base), over)
    return merged


def leaves(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The values inside a value by dotted key; mappings are sections."""
    if isinstance(value, Mapping) and value:
        for name, item in value.items():
            yield from leaves(f"{key}.{name}", item)
    else:
        yield key, value


def value_at(settings: Mapping[str, Any], dotted: str) -> Any:
    """The value of a dotted key in nested settings.

    Raises:
        KeyError, TypeError: there is no such setting.
    """
    return reduce(getitem, dotted.split("."), settings)


def flattened(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings by dotted key, without empty sections."""
    pairs = (pair for key, value in settings.items() for pair in leaves(key, value))
    return {key: value for key, value in pairs if not isinstance(value, Mapping)}


def _laid_over(path: list[str], old: Any, new: Any) -> Any:
    if not (isinstance(old, Mapping) and isinstance(new, Mapping)) or _another_kind(path, old, new):
        return copy.deepcopy(new)
    result = {key: copy.deepcopy(value) for key, value in old.items() if key not in new}
    return result | {key: _laid_over([*path, str(key)], old.get(key), value) for key, value in new.items()}


def _another_kind(path: list[str], old: Mapping[str, Any], new: Mapping[str, Any]) -> bool:
    """Whether two mappings for the same setting are of different kinds."""
    tag = "name" if path in (["env"], ["algorithm"]) else "kind"
    return tag in new and tag in old and new[tag] != old[tag]
