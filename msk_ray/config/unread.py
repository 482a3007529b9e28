"""Settings that have no effect in a trial, because its environment or another setting makes them unused.

They are refused: a sweep over one would run the same trial many times under different names.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from msk_ray.config.physics import PhysicsConfig
from msk_ray.config.terms import unread_without_weight

if TYPE_CHECKING:
    from msk_ray.config.schema import Config


def unread_settings(config: Config) -> Iterator[tuple[str, str]]:
    """(dotted key, reason) of each setting without effect that is not at its default."""
    for key, why in _unread(config).items():
        *sections, name = key.split(".")
        owner: Any = config
        for section in sections:
            owner = getattr(owner, section)
        default = type(owner).model_fields[name].default
        if getattr(owner, name) != default:
            yield key, why


def _unread(config: Config) -> dict[str, str]:
    env, physics = config.env, config.physics
    mode = f"physics.backward is {physics.backward}"
    unread = {f"physics.{name}": _while(mode) for name in _unread_by_backward(config)}
    if (physics.cone or ("pyramidal" if physics.variant in env.pyramidal_variants else "elliptic")) == "pyramidal":
        why = "nothing reads it while friction cones are pyramids; write physics.cone: elliptic, or"
        unread["physics.solreffriction"] = why
        if config.curriculum is not None:
            unread["curriculum.start.solreffriction"] = why
    alien = [name for name in PhysicsConfig.names() if name not in env.reads_physics]
    unread |= {f"physics.{name}": f"env {env.name} does not read it;" for name in alien}
    own = env.unread() | unread_without_weight(env)
    unread |= {f"env.{name}": _while(why) for name, why in own.items()}
    section = config.algorithm_section
    own = config.algorithm_settings.unread()
    unread |= {f"{section}.{name}": _while(f"{section}.{why}") for name, why in own.items()}
    return unread


def _unread_by_backward(config: Config) -> list[str]:
    """Fields of the physics section that the backward mode does not use."""
    state = ["fd.eps_qpos", "fd.eps_qvel", "fd.eps_act"]
    match config.physics.backward:
        case "fd_jacobian":
            return ["substep_grad_clip"]
        case "hybrid":
            return state
        case _:
            return [*state, "fd.eps_ctrl"]


def _while(why: str) -> str:
    return f"nothing reads it while {why};"
