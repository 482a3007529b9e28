"""Settings as earlier versions spelt them, and the part of a trial's settings that its id is a hash of.

Files and records may use either spelling; on the command line the old one is refused.
"""

import copy
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from msk_ray.errors import ConfigError, brief

SCHEMA = 2
"""Version of the scheme of trial ids; it is hashed too."""

_EXECUTION = {
    "trial": ("gpus", "threads", "deterministic", "checkpoint_interval", "keep_checkpoints", "loggers"),
    "physics": ("solver_kernels", "jacobian", "nconmax", "njmax"),
    "shac": ("capture",),
}
"""Settings now in `execution`, by their section until version 0.2."""
_MOVED = {f"{section}.{name}": f"execution.{name}" for section, names in _EXECUTION.items() for name in names}

_REMOVED: dict[str, Any] = {
    "actor.layer_norm": True,
    "actor.stochastic": True,
    "critic.layer_norm": True,
    "curriculum.reward": None,
    "curriculum.start.friction": None,
    "curriculum.start.solimp": None,
    "physics.armature": None,
    "physics.contact_reach": None,
    "physics.fd.max_worlds": 131072,
    "physics.friction": None,
    "physics.gear": None,
    "physics.impratio": None,
    "physics.joint_damping": None,
    "physics.solimp_limit": None,
    "physics.solref_limit": None,
    "ppo.clip_value": True,
    "ppo.grad_norm": 1.0,
    "ppo.init_std": 1.0,
    "ppo.normalize_obs": True,
    "ppo.value_coefficient": 1.0,
    "shac.betas": [0.7, 0.95],
    "shac.copies": None,
    "shac.critic_kernels": ...,
    "shac.critic_method": "td-lambda",
    "shac.critic_products": ...,
    "shac.entropy.rate": 5e-3,
    "shac.horizon.rate": 0.1,
    "shac.max_nonfinite_share": 0.05,
    "shac.normalize_obs": True,
    "trial.seeds": dict.fromkeys(("policy", "states", "noise", "minibatches")),
}
"""Removed settings, with the only value still accepted in files, which is what is done now. An ellipsis accepts any."""
_REMOVED_FROM_LEGS: dict[str, Any] = {
    "assist.balance": 800.0,
    "assist.lateral": 800.0,
    "assist.support": 0.0,
    "min_height": 0.65,
    "min_upright": 0.5,
    "rest_excitation": 0.02,
    "reward.cadence": 112.0,
    "reward.capture_scale": 0.1,
    "reward.fatigue": 0.0,
    "reward.stride_angle": 0.75,
    "reward.track_rate_scale": 2.0,
    "reward.track_scale": 0.15,
    "success_speed": 0.8,
    "tracking": {"start": 1.0, "end": 1.0, "epochs": 0},
}
_REMOVED_FROM_ENVS: dict[str, dict[str, Any]] = {
    "hopper": {"reward.drop": 200.0, "reward.full_height": -0.3},
    "humanoid": {"reward.drop": 200.0, "reward.full_height": 0.84},
    "myoleg": _REMOVED_FROM_LEGS,
    "myoleg26": {**_REMOVED_FROM_LEGS, "terrain.seed": 0, "terrain.start": 0.8, "terrain.step_depth": 0.6},
    "myosuite_walk": {"assist.balance": 800.0, "assist.lateral": 800.0, "assist.support": 0.0},
}
"""The same for the section of each of the package's environments, dotted within it."""
_REMOVED_FROM_SPACES: dict[str, Any] = {"smoke": {"overrides": {}, "max_trials": 8}}
"""The same for a space file's own settings."""
REMOVED = "has been removed; leave it out, or use version 0.2"


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
        ConfigError: a removed setting had an effect.
    """
    of_env = _REMOVED_FROM_ENVS.get(env_name(settings) or "", {})
    result = _without({**_REMOVED, **{f"env.{name}": value for name, value in of_env.items()}}, settings)
    for dotted in _MOVED:
        for value in _taken(result, dotted):
            result["execution"] = {**(result.get("execution") or {}), dotted.rpartition(".")[2]: value}
    if isinstance(shac := result.get("shac"), dict) and "horizon" in shac:
        shac["horizon"] = _with_kind(shac["horizon"])
    return result


def current_space(data: Mapping[str, Any]) -> dict[str, Any]:
    """A space file's own settings in the current spelling; its trials' settings are left as they are.

    Raises:
        ConfigError: one of them no longer exists and had an effect.
    """
    return _without(_REMOVED_FROM_SPACES, data)


def current_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted keys and their values in the current spelling.

    Raises:
        ConfigError: a removed setting had an effect.
    """
    result: dict[str, Any] = {}
    for key, value in values.items():
        if key in _REMOVED:
            _check_harmless(key, value, _REMOVED[key])
        elif key in _MOVED or not isinstance(value, Mapping):
            result[current_key(key)] = value
        elif "." not in key:
            result |= current_settings({**result, key: value})
        else:
            result[key] = _current_section(key, value)
    return result


def _current_section(dotted: str, values: Mapping[str, Any]) -> Any:
    """A section within sections, in the current spelling."""
    sections = dotted.split(".")
    settings = values
    for section in reversed(sections):
        settings = {section: settings}
    current: Any = current_settings(settings)
    for section in sections:
        current = current[section]
    return current


def _without(removed: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of nested settings without those removed, if these had no effect."""
    result: dict[str, Any] = copy.deepcopy(dict(settings))
    for dotted, harmless in removed.items():
        for value in _taken(result, dotted):
            _check_harmless(dotted, value, harmless)
    return result


def _taken(settings: dict[str, Any], dotted: str) -> Iterator[Any]:
    """The value of a setting, which is taken out of nested settings in place; nothing if it is not there."""
    *sections, name = dotted.split(".")
    owner: Any = settings
    for section in sections:
        owner = owner.get(section) if isinstance(owner, dict) else None
    if isinstance(owner, dict) and name in owner:
        yield owner.pop(name)


def _with_kind(horizon: Any) -> Any:
    """Add the `kind` to a horizon, or to an operator's horizons, as older versions wrote them. Mappings that only
    change some of a horizon's settings stay unchanged."""
    if isinstance(horizon, list):
        return [_with_kind(item) for item in horizon]
    if not isinstance(horizon, Mapping) or "kind" in horizon:
        return horizon
    signs = {"adaptive": {"target"}, "contact": {"contact"}, "schedule": {"start", "end", "epochs"}}
    kind = next((kind for kind, keys in signs.items() if keys <= horizon.keys()), None)
    if kind is None:
        return {key: _with_kind(value) for key, value in horizon.items()}
    return {"kind": kind, **horizon}


def _check_harmless(dotted: str, value: Any, harmless: Any) -> None:
    part = isinstance(harmless, Mapping) and isinstance(value, Mapping) and value.items() <= harmless.items()
    if harmless is not ... and value != harmless and not part:
        raise ConfigError(f"{dotted}: {brief(value)} {REMOVED}")


def newer_spelling(dotted: str) -> str | None:
    """What to write instead of a setting of an earlier version; None if it is not one."""
    section, _, setting = dotted.partition(".")
    if dotted in _REMOVED or (section == "env" and any(setting in names for names in _REMOVED_FROM_ENVS.values())):
        return f"it {REMOVED}"
    return f"write {_MOVED[dotted]}" if dotted in _MOVED else None


def changed_settings(section: BaseModel) -> dict[str, Any]:
    """Plain data of the settings that differ from their defaults.

    Adding a setting to the program, with a default that changes nothing, does not change this data.
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
