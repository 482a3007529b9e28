"""Read configurations: from YAML to a checked `Config`, or one line that says what to write instead."""

import contextlib
import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel, Tag, ValidationError

from msk_ray.config.algorithms import BUILT_IN, settings_from_outside
from msk_ray.config.environments import settings_class
from msk_ray.config.overlay import leaves, merge, overlay, parse_overrides
from msk_ray.config.recorded import current_settings, env_name
from msk_ray.config.schema import Config
from msk_ray.config.sections import RECORDED, SHOWN
from msk_ray.config.unread import unread_settings
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
    """The configuration in a trial's files, written by this version or an earlier one.

    Settings that nothing read then, and that are refused now, get their defaults.

    Args:
        shown: it is only shown: of a class that cannot be found here (`Config.undeclared`), take what is recorded.

    Raises:
        ConfigError: as for `parse_config`.
    """
    settings = current_settings(data, env_name(data)) if isinstance(data, Mapping) else data
    try:
        config = Config.model_validate(settings, context=SHOWN if shown else RECORDED)
        unread = {key: default for key, _, default in unread_settings(config)}
        context = SHOWN if shown else None
        return Config.model_validate(overlay(config.as_dict(), unread), context=context) if unread else config
    except ValidationError as error:
        raise ConfigError(f"{source}: {describe_fault(error, named=_named(settings))}") from None


def read_config(path: Path) -> dict[str, Any]:
    """The settings of a config file merged into those of the file that it `extends`, if any, in the current spelling.

    `extends` is a path relative to the file, and only one level deep: an extended file may not extend another.

    Raises:
        ConfigError: as for `read_yaml`, or a chain of `extends`.
    """
    data = read_yaml(path)
    base_name = data.pop("extends", None)
    if base_name is None:
        return current_settings(data, env_name(data))
    base_path = path.parent / str(base_name)
    base = read_yaml(base_path)
    if "extends" in base:
        raise ConfigError(f"{path} extends {base_path}, which extends another file: extend that one directly")
    name = env_name(data) or env_name(base)
    return merge(current_settings(base, name), current_settings(data, name))


def find_config(path: str | Path) -> Path:
    """The file of a config's path, or of its name in `configs/` of the current folder or of the package; a path to no
    file is returned as it is, for `read_config` to describe.

    Raises:
        ConfigError: there is none of that name; the message lists the known ones.
    """
    found = find_shipped(path, CONFIGS, ".yaml")
    if found is None and is_name(path):
        known = ", ".join(shipped_names(CONFIGS, ".yaml"))
        raise ConfigError(f"unknown config {brief(str(path))}; known: {known}, or give a path to a .yaml file")
    return Path(path) if found is None else found


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
    """Refuse dotted settings that the algorithm of none of the trials reads. `source` names them in errors.

    A file may hold settings for algorithms that the trial does not run, but settings given for the trial itself may
    not.

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
    """Sections, dotted, whose settings are declared by the class of the `name` beside them, if it can be found."""
    found: dict[str, type[BaseModel]] = {}
    if not isinstance(data, Mapping):
        return found
    with contextlib.suppress(ConfigError):  # this is the error that is described
        found["env"] = settings_class(env_name(data))
    algorithm = data.get("algorithm")
    name = algorithm.get("name") if isinstance(algorithm, Mapping) else None
    if isinstance(name, str) and name not in BUILT_IN:
        with contextlib.suppress(ConfigError):
            found["algorithm.settings"] = settings_from_outside(name)
    return found


def describe_fault(
    error: ValidationError, root: type[BaseModel] = Config, *, named: Mapping[str, type[BaseModel]] | None = None
) -> str:
    """The first error found while validating a `root`, and how many more there are, on one line.

    Args:
        error: the error that the validation raised.
        root: the class validated.
        named: open sections of `root`, dotted, with the class that each was validated as.
    """
    faults = error.errors()
    # A misspelt key is often missing under its right name too; report the misspelling.
    first = min(faults, key=lambda fault: fault["type"] != "extra_forbidden")
    location = [shortened(str(part)) for part in _without_tags(first["loc"])]
    where = ".".join(location)
    if first["type"] == "extra_forbidden":
        section = _model_at(root, location[:-1], first["loc"], named or {})
        known = list(section.model_fields)
        near = difflib.get_close_matches(location[-1], known, n=1)
        below = _subsection_with(section, location[-1], (named or {}) if section is root else {})
        if below is not None:
            hint = f"write {'.'.join([*location[:-1], below, location[-1]])}"
        else:
            hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(known)}"
        text = f"{where}: unknown key; {hint}"
    elif first["type"] == "value_error":
        text = str(first["ctx"]["error"]) if "ctx" in first else first["msg"]
    elif first["type"] == "missing":
        text = f"{where}: missing; write it"
    else:
        text = f"{where}: {first['msg']}, not {brief(first['input'])}"
    more = len(faults) - 1
    text = shortened(" ".join(text.split()), _MAX_MESSAGE)
    return text + (f" (and {more} more error{'s' if more > 1 else ''})" if more else "")


_MAX_MESSAGE = 400


_TAGGED = {"horizon": ("constant", "schedule", "adaptive", "contact")}
"""Settings of several kinds, and the tags of these."""


def _without_tags(location: tuple[Any, ...]) -> list[Any]:
    """An error's location without the tags that pydantic puts behind a setting of several kinds: they are no keys."""
    pairs = zip((None, *location), location, strict=False)
    return [part for before, part in pairs if part not in _TAGGED.get(str(before), ())]


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _subsection_with(section: type[BaseModel], key: str, named: Mapping[str, type[BaseModel]]) -> str | None:
    """The section within `section` that has a setting of this name."""
    for name, field in section.model_fields.items():
        kind = named.get(name, field.annotation)
        if _is_model(kind) and key in kind.model_fields:  # type: ignore[union-attr]
            return name
    return None


def _model_at(
    root: type[BaseModel], sections: list[str], location: tuple[Any, ...], named: Mapping[str, type[BaseModel]]
) -> type[BaseModel]:
    """The section of `root` that contains an error."""
    model: Any = root
    for depth, section in enumerate(sections):
        dotted = ".".join(sections[: depth + 1])
        if dotted in named:
            model = named[dotted]
            continue
        annotation = model.model_fields[section].annotation
        # A member of a union is Annotated with its tag.
        options = [get_args(a) if get_origin(a) is Annotated else (a,) for a in get_args(annotation) or (annotation,)]
        models = [(o[0], [m.tag for m in o[1:] if isinstance(m, Tag)]) for o in options if _is_model(o[0])]
        model = next((m for m, tags in models if any(tag in location for tag in tags)), models[0][0])
    found: type[BaseModel] = model
    return found
