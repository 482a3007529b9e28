"""Settings as earlier versions spelt them, and the content of a trial that its id is a hash of.

Files and records of earlier versions are read in either spelling; on the command line the old one is refused.
"""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from msk_ray.errors import ConfigError, brief

SCHEMA = 2
"""Number of the scheme by which trials get their ids; it is part of what is hashed."""

_EXECUTION = {
    "trial": ("gpus", "threads", "deterministic", "checkpoint_interval", "keep_checkpoints", "loggers"),
    "physics": ("solver_kernels", "jacobian", "nconmax", "njmax"),
    "shac": ("capture",),
}
"""Settings that have moved into `execution`, by the section that they were in until version 0.2."""
_MOVED = {f"{section}.{name}": f"execution.{name}" for section, names in _EXECUTION.items() for name in names}

_REMOVED: dict[str, Any] = {
    "physics.contact_reach": None,
    "shac.copies": None,
    "shac.critic_kernels": ...,
    "shac.critic_products": ...,
}
"""Settings that no longer exist, with the only value that can still be read; an ellipsis stands for any."""
REMOVED = "has been removed, because it did not pay; leave it out, or use version 0.2"


def env_name(settings: Mapping[str, Any]) -> str | None:
    """The name of the environment in nested settings, if there is one."""
    env = settings.get("env")
    name = env.get("name") if isinstance(env, Mapping) else None
    return name if isinstance(name, str) else None


def current_key(dotted: str) -> str:
    """A dotted key in the current spelling."""
    return _MOVED.get(dotted, dotted)


def current_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings in the current spelling.

    Raises:
        ConfigError: one of them no longer exists and had an effect.
    """
    result = {key: dict(value) if isinstance(value, Mapping) else value for key, value in settings.items()}
    for dotted in (*_REMOVED, *_MOVED):
        section, _, setting = dotted.partition(".")
        owner = result.get(section)
        if not (isinstance(owner, dict) and setting in owner):
            continue
        value = owner.pop(setting)
        if dotted in _REMOVED:
            _check_harmless(dotted, value)
        else:
            result["execution"] = {**(result.get("execution") or {}), setting: value}
    if isinstance(shac := result.get("shac"), dict) and "horizon" in shac:
        shac["horizon"] = _with_kind(shac["horizon"])
    return result


def current_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted keys and their values in the current spelling.

    Raises:
        ConfigError: one of them no longer exists and had an effect.
    """
    result: dict[str, Any] = {}
    for key, value in values.items():
        if key in _REMOVED:
            _check_harmless(key, value)
        elif "." in key or not isinstance(value, Mapping):
            result[current_key(key)] = _with_kind(value) if key == "shac.horizon" else value
        else:
            result |= current_settings({**result, key: value})
    return result


def _with_kind(horizon: Any) -> Any:
    """A horizon of before kinds had names, or the horizons of an operator; a mapping that only changes some settings is
    left as it is."""
    if isinstance(horizon, list):
        return [_with_kind(item) for item in horizon]
    if not isinstance(horizon, Mapping) or "kind" in horizon:
        return horizon
    signs = {"adaptive": {"target"}, "contact": {"contact"}, "schedule": {"start", "end", "epochs"}}
    kind = next((kind for kind, keys in signs.items() if keys <= horizon.keys()), None)
    if kind is None:
        return {key: _with_kind(value) for key, value in horizon.items()}
    return {"kind": kind, **horizon}


def _check_harmless(dotted: str, value: Any) -> None:
    harmless = _REMOVED[dotted]
    if harmless is not ... and value != harmless:
        raise ConfigError(f"{dotted}: {brief(value)} {REMOVED}")


def newer_spelling(dotted: str) -> str | None:
    """What to write instead of a setting of an earlier version; None if it is not one."""
    if dotted in _REMOVED:
        return f"it {REMOVED}"
    return f"write {_MOVED[dotted]}" if dotted in _MOVED else None


def changed_settings(section: BaseModel) -> dict[str, Any]:
    """Plain data of the settings that differ from the defaults of their section.

    A setting that is added later, with a default that changes nothing, leaves it as it is.
    """
    changed: dict[str, Any] = {}
    data = section.model_dump(mode="json")
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        required = field.is_required()
        default = None if required else field.get_default(call_default_factory=True)
        if required or name == "kind" or value != default:
            changed[name] = changed_settings(value) if isinstance(value, BaseModel) else data[name]
    return changed
