"""Sections of settings that are made from the terms of a reward."""

from collections.abc import Callable
from typing import Any, TypeVar

from pydantic import create_model

from msk_ray.config.sections import EnvSettings, Reward
from msk_ray.config.terms import Term

SettingsT = TypeVar("SettingsT", bound=EnvSettings)


def reward_section(name: str, module: str, terms: tuple[Term, ...], base: type[Reward] = Reward) -> type[Reward]:
    """The section `name` of a module: the settings of `base`, and the weights of the terms."""
    names = [term.name for term in terms]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"two terms have the name {min(twice)!r}")
    weights: dict[str, Any] = {term.setting: (term.kind, term.weight) for term in terms if term.weight is not None}
    section = create_model(name, __base__=base, __module__=module, __doc__="Weights per env step.", **weights)
    section.terms, section.without_weights = terms, base if not base.terms else base.without_weights
    return section


def with_reward(section: type[Reward]) -> Callable[[type[SettingsT]], type[SettingsT]]:
    """Decorator of settings whose `reward` is this section."""

    def decorate(settings: type[SettingsT]) -> type[SettingsT]:
        made = create_model(
            settings.__name__,
            __base__=settings,
            __module__=settings.__module__,
            __doc__=settings.__doc__,
            reward=(section, section()),
        )
        made.__qualname__ = settings.__qualname__
        _check_needs(made)
        return made

    return decorate


def settings_with(terms: tuple[Term, ...], settings: type[EnvSettings], owner: type) -> type[EnvSettings]:
    """`settings` with the weights of these terms, as `Settings` of the class `owner`."""
    declared: Any = settings.model_fields["reward"].annotation
    if declared.terms == terms:
        return settings
    base = declared if set(declared.terms) <= set(terms) else declared.without_weights
    section = reward_section("Reward", owner.__module__, terms, base)
    made = with_reward(section)(settings)
    # So that pickle finds them.
    made.__module__, made.__qualname__ = owner.__module__, f"{owner.__qualname__}.Settings"
    section.__qualname__ = f"{made.__qualname__}.Reward"
    made.Reward = section  # type: ignore[attr-defined]
    return made


def _check_needs(settings: type[EnvSettings]) -> None:
    reward: Any = settings.model_fields["reward"].annotation
    for term in reward.terms:
        for need in term.needs:
            section: Any = settings
            for part in need.split("."):
                if part not in getattr(section, "model_fields", {}):
                    raise ValueError(f"term {term.name!r} needs env.{need}, which {settings.__name__} does not have")
                section = section.model_fields[part].annotation
