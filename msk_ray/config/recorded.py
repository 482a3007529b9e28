"""Settings written by earlier versions: the one place that converts old spellings to the current one.

Until November 2026 the reward weights were among the other settings of `env`; now they are `env.reward`. Files are read
in either spelling; on the command line the old one is refused.
"""

from collections.abc import Mapping
from typing import Any

_LEGS = (
    *("forward_vel", "speed_scale", "progress", "upright", "heading", "height", "alive", "effort", "joint_limit"),
    *("smoothness", "capture", "capture_scale", "sway", "symmetry", "stride", "stride_angle", "cadence"),
)
_ONCE_FLAT: dict[str, tuple[str, ...]] = {
    "cartpole": (
        *("pole_angle_penalty", "pole_velocity_penalty", "cart_position_penalty", "cart_velocity_penalty"),
        "cart_action_penalty",
    ),
    "ant": ("forward_vel", "heading", "up", "height", "action_penalty"),
    "myoleg26": _LEGS,
    "myoleg": _LEGS,
}
"""Settings of `env` that have moved into `env.reward`, by the environment's name."""


def env_name(settings: Mapping[str, Any]) -> str | None:
    """The name of the environment in nested settings, if there is one."""
    env = settings.get("env")
    name = env.get("name") if isinstance(env, Mapping) else None
    return name if isinstance(name, str) else None


def current_settings(settings: Mapping[str, Any], name: str | None) -> dict[str, Any]:
    """Nested settings of environment `name` in the current spelling."""
    moved = _ONCE_FLAT.get(name or "", ())
    env = settings.get("env")
    if not isinstance(env, Mapping) or "reward" in env or not any(key in env for key in moved):
        return dict(settings)
    rest = {key: value for key, value in env.items() if key not in moved}
    reward = {key: value for key, value in env.items() if key in moved}
    return {**settings, "env": {**rest, "reward": reward}}


def current_key(dotted: str, name: str | None) -> str:
    """A dotted key of environment `name` in the current spelling."""
    section, _, key = dotted.partition(".")
    return f"env.reward.{key}" if section == "env" and key in _ONCE_FLAT.get(name or "", ()) else dotted


def current_values(values: Mapping[str, Any], name: str | None) -> dict[str, Any]:
    """Dotted keys and their values, for environment `name`, in the current spelling."""
    return {
        current_key(key, name): current_settings({"env": value}, name)["env"] if key == "env" else value
        for key, value in values.items()
    }


def first_spelling(settings: Mapping[str, Any]) -> dict[str, Any]:
    """A complete configuration's plain data in the form of the first version, whose hashes are the trials' ids.

    This way a trial keeps its id in every version. A setting that was added later belongs in `_LATER`.
    """
    env = dict(settings["env"])
    if env["name"] in _ONCE_FLAT:
        env |= env.pop("reward")
    spelt = {**settings, "env": env}
    for path, default in _LATER.items():
        spelt = _without(spelt, path, default)
    for path, default in _LATER_OF.get(env["name"], {}).items():
        spelt = _without(spelt, path, default)
    if not spelt["algorithm"]:
        del spelt["algorithm"]
    return spelt


def _without(settings: Mapping[str, Any], path: tuple[str, ...], default: Any) -> dict[str, Any]:
    """`settings` without the one at `path`, if it has that value."""
    name, *rest = path
    found = dict(settings)
    if rest and isinstance(found.get(name), Mapping):
        found[name] = _without(found[name], tuple(rest), default)
    elif not rest and name in found and found[name] == default:
        del found[name]
    return found


_LATER: dict[tuple[str, ...], Any] = {
    ("physics", "randomize"): None,
    ("physics", "contact_reach"): None,
    ("physics", "jacobian"): None,
    ("physics", "solver_kernels"): "mujoco_warp",
    ("trial", "seeds"): dict.fromkeys(("policy", "states", "noise", "minibatches")),
    ("trial", "deterministic"): False,
    ("trial", "threads"): 1,
    ("trial", "gpus"): 1,
    ("trial", "loggers"): ["tensorboard"],
    ("algorithm", "name"): "shac",
    ("shac", "capture"): "auto",
    ("shac", "critic_tolerance"): None,
    ("shac", "critic_products"): "float32",
    ("shac", "critic_kernels"): "torch",
    ("shac", "entropy", "normalize"): False,
    ("shac", "weight_decay"): 0.0,
    ("shac", "actor_value"): "smaller",
    ("shac", "exploration"): None,
    ("shac", "copies"): None,
    ("actor", "state_std"): False,
    ("env", "spread_resets"): False,
    ("env", "speed_range"): None,
    ("env", "clock"): False,
    ("env", "symmetric"): False,
    ("env", "gait_worlds"): 0,
    ("env", "toe_stiffness"): 0.0,
    ("env", "assist", "power"): 1.0,
    ("env", "assist", "steady"): None,
    ("env", "push"): {"speed": 0.0, "interval": 2.0},
    ("env", "tracking"): {"start": 1.0, "end": 1.0, "epochs": 0},
    **{
        ("env", name): 0.0
        for name in (
            *("metabolic", "fatigue", "head", "impact", "footfall", "clearance", "toes", "vault"),
            *("out_of_plane", "track", "track_rate", "landing"),
        )
    },
    ("env", "clearance_height"): 0.01,
    ("env", "track_scale"): 0.15,
    ("env", "track_rate_scale"): 2.0,
}
"""Settings that the first version did not have, as (section, name), with the default that leaves ids unchanged."""

_NO_ASSISTANCE = {"epochs": 0, "share": 1.0, "balance": 800.0, "lateral": 800.0, "support": 0.0}
_LATER_OF: dict[str, dict[tuple[str, ...], Any]] = {
    "ant": {("env", "joint_limit"): 0.0, ("env", "joint_limit_epochs"): 0},
    **{
        name: {("env", "reward", "joint_limit"): 0.0, ("env", "joint_limit_epochs"): 0}
        for name in ("hopper", "cheetah", "humanoid")
    },
    "myoleg": {("env", "assist"): _NO_ASSISTANCE, ("env", "reset"): "stand"},
    "myosuite_walk": {
        ("env", "assist"): _NO_ASSISTANCE,
        ("env", "cycle"): 0.0,
        **{("env", "reward", name): 0.0 for name in ("height", "effort", "footfall", "clearance")},
        ("env", "reward", "clearance_height"): 0.02,
    },
}
"""The same of one environment, by its name, where others had a setting of that name from the first."""
