"""Reading YAML: plain data only, within limits, so that no file can hang the program or exhaust its memory."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from msk_ray.errors import ConfigError, brief, shortened

MAX_BYTES = 1 << 20
"""Largest file or value [B]; a space of thousands of variants needs a tenth of it."""
MAX_DEPTH = 32
"""Largest nesting depth of mappings and lists."""
MAX_NODES = 200_000
"""Largest number of values after aliases (`*name`) are expanded."""
MAX_INTEGER = 1 << 63


class _NotSettings(yaml.YAMLError):
    """A document exceeds the limits for settings."""


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with limits on a document's expanded size; refuses duplicate keys."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.number_keys = False
        self._depth = 0
        self._extent: dict[yaml.Node, tuple[int, int]] = {}
        """(number of values, depth) of each node read, with aliases expanded."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        alias = self.check_event(yaml.AliasEvent)
        tag = getattr(self.peek_event(), "tag", None)
        if tag not in (None, "!"):
            raise _NotSettings(f"settings are plain data; leave out the tag {brief(tag)}")
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise _NotSettings(f"more than {MAX_DEPTH} mappings and lists inside each other")
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        if node is None:
            return node
        if alias and node not in self._extent:
            raise _NotSettings("an alias refers to a value that contains it")
        if node not in self._extent:
            if isinstance(node, yaml.ScalarNode) and not node.value.isascii():
                node.value.encode()  # an escaped lone surrogate could never be printed
            children: list[yaml.Node] = []
            if isinstance(node, yaml.SequenceNode):
                children = node.value
            elif isinstance(node, yaml.MappingNode):
                _check_keys(node, self.number_keys)
                children = [part for pair in node.value for part in pair]
            below = [self._extent[child] for child in children]
            size = 1 + sum(count for count, _ in below)
            depth = 1 + max((levels for _, levels in below), default=0)
            if size > MAX_NODES:
                raise _NotSettings(f"more than {MAX_NODES} values once its aliases are written out")
            if depth > MAX_DEPTH:
                raise _NotSettings(f"more than {MAX_DEPTH} mappings and lists inside each other")
            self._extent[node] = size, depth
        return node

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        number: int = super().construct_yaml_int(node)
        if abs(number) >= MAX_INTEGER:
            raise _NotSettings(f"whole numbers must be below 2^63, not {shortened(node.value, 40)}")
        return number


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
# A date is read as text: no setting is a date, and an invalid one could not be read.
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


_WHOLE_NUMBER = "tag:yaml.org,2002:int"
_NO_NAMES = {
    f"tag:yaml.org,2002:{kind}": shown
    for kind, shown in (
        ("bool", "true or false"),
        ("int", "a whole number"),
        ("float", "a number"),
        ("null", "null"),
    )
}
"""How YAML may read an unquoted key, by tag."""


def _check_keys(node: yaml.MappingNode, numbers: bool) -> None:
    """Refuse keys that are not text, or whole numbers if `numbers`, and duplicate keys, of which PyYAML would keep the
    last."""
    seen: set[tuple[str, str]] = set()
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise _NotSettings("a key must be a name, not a list or a mapping")
        if key.tag in _NO_NAMES and not (numbers and key.tag == _WHOLE_NUMBER):
            raise _NotSettings(
                f"key {shortened(key.value, 60)!r} is {_NO_NAMES[key.tag]} in YAML, not a name; write a name, in "
                "quotes if it is one"
            )
        if (key.tag, key.value) in seen:
            raise _NotSettings(f"key {brief(key.value)} is written twice; leave one of them out")
        seen.add((key.tag, key.value))


def parse_yaml(text: str, source: str, *, number_keys: bool = False) -> Any:
    """Plain data from YAML text. `source` names it in errors; keys may be whole numbers only with `number_keys`.

    Raises:
        ConfigError: it is not YAML, holds anything but plain data, has a duplicate key, or exceeds the limits.
    """
    if len(text) > MAX_BYTES:
        raise ConfigError(f"{source} is larger than {MAX_BYTES} bytes: too large for settings")
    try:
        loader = _Loader(text)
        loader.number_keys = number_keys
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except _NotSettings as error:
        raise ConfigError(f"{source}: {error}") from error
    except (yaml.YAMLError, ValueError) as error:
        # ValueError: an integer of thousands of digits.
        reason = shortened(" ".join(str(error).split()), 300)
        raise ConfigError(f"{source} is not valid YAML: {reason}") from error


def read_yaml(path: Path, *, number_keys: bool = False) -> dict[str, Any]:
    """The mapping in a YAML file; its keys may be whole numbers only with `number_keys`.

    Raises:
        ConfigError: the file is missing, unreadable, not YAML, too large, or not a mapping.
    """
    try:
        # One byte more than allowed shows that there is more.
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise ConfigError(f"{path} is larger than {MAX_BYTES} bytes: too large for settings")
        text = data.decode("utf-8")
    except FileNotFoundError:
        siblings = sorted(p.stem for p in path.parent.glob("*.yaml")) if path.parent.is_dir() else []
        hint = shortened(f"; {path.parent} holds: {', '.join(siblings)}", 500) if siblings else ""
        raise ConfigError(f"no such file: {path}{hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8"
        raise ConfigError(f"cannot read {path}: {reason or error}") from error
    return parse_settings(text, str(path), number_keys=number_keys)


def parse_settings(text: str, source: str, *, number_keys: bool = False) -> dict[str, Any]:
    """The mapping in YAML text. `source` names it in errors.

    Raises:
        ConfigError: as for `parse_yaml`, or it is not a mapping.
    """
    settings = parse_yaml(text, source, number_keys=number_keys)
    if not isinstance(settings, dict):
        raise ConfigError(f"{source} must hold a mapping of settings at its top level")
    return settings


def dump_yaml(data: Mapping[str, Any]) -> str:
    """YAML text of plain data, in the order given."""
    return yaml.safe_dump(dict(data), sort_keys=False, allow_unicode=True, width=100)
