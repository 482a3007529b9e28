"""Terms of a reward: each is a name, a weight and a function, in a list that its environment owns.

The list makes the weights settings of `env.reward`, whose defaults are the reference reward, and says what they need.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import BaseModel, Field

from msk_ray.errors import ConfigError
from msk_ray.registry import resolve

if TYPE_CHECKING:
    from msk_ray.config.sections import EnvSettings, Reward


@dataclass(frozen=True)
class Term:
    """A part of a reward: the weight `env.reward.NAME` times what a function measures."""

    name: str
    """In logs and reports."""
    weight: float | None
    """Default of the weight, which scores are taken with; None if the function weighs its value itself."""
    function: Callable[..., Any] | str | None = None
    """`function(env, state, action, obs)` gives a value for each world, (W,); `Env.reward_terms` says of what. Or its
    import path `package.module:function`, so that settings can be read without torch."""
    needs: tuple[str, ...] = ()
    """Settings of the environment, dotted, that are there for this term and others that name them: switches, which have
    to be on where it has a weight, and others, which nothing reads where none of these terms has one."""
    schedule: Callable[[Any, int], float] | None = None
    """`schedule(settings, epoch)` gives a factor on the weight in training, for epochs counted from 0."""
    optional: bool = False
    """Whether it is computed and listed only where its weight is not 0."""
    gradient: bool = True
    """Whether it is meant to have a gradient to state or action."""
    setting: str = ""
    """Name of the weight in `env.reward` if it is not that of the term."""

    sign: ClassVar[float] = 1.0
    kind: ClassVar[Any] = float

    def __post_init__(self) -> None:
        object.__setattr__(self, "setting", self.setting or self.name)

    def weight_in(self, reward: Reward) -> float:
        """The weight in a reward section, at least 0 for costs."""
        return 1.0 if self.weight is None else float(getattr(reward, self.setting))

    @property
    def measure(self) -> Callable[..., Any]:
        """The function.

        Raises:
            ConfigError: there is none, or none at its import path.
        """
        if isinstance(self.function, str):
            function: Callable[..., Any] = resolve(self.function, f"term {self.name!r}")
            return function
        if self.function is None:
            raise ConfigError(f"term {self.name!r} has no function: write Term(name, weight, function)")
        return self.function


@dataclass(frozen=True)
class Cost(Term):
    """A term that is subtracted; its weight is at least 0."""

    sign = -1.0
    kind = Annotated[float, Field(ge=0.0)]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.weight is None or self.weight < 0.0:
            raise ValueError(f"cost {self.name!r} needs a weight of at least 0, because it is subtracted")


def terms_in(module: str, *terms: Term) -> tuple[Term, ...]:
    """Terms whose functions are in a module that need not be loaded before they are called: those of the terms' names,
    unless a term says another name or import path."""

    def path(term: Term) -> Callable[..., Any] | str:
        function = term.function or term.name
        return f"{module}:{function}" if isinstance(function, str) and ":" not in function else function

    return tuple(replace(term, function=path(term)) for term in terms)


def check_switches(settings: EnvSettings) -> None:
    """Raise ValueError if a term with a weight needs a switch that is off."""
    for term in settings.reward.terms:
        for need in term.needs if term.weight_in(settings.reward) else ():
            if _at(settings, need) is False:
                raise ValueError(f"env.reward.{term.setting} needs env.{need}: write env.{need}: true")


def unread_without_weight(settings: EnvSettings) -> dict[str, str]:
    """The settings that only terms without a weight need, dotted, with the reason."""
    users: defaultdict[str, list[Term]] = defaultdict(list)
    for term in settings.reward.terms:
        for need in term.needs:
            users[need].append(term)
    unread: dict[str, str] = {}
    for need, terms in users.items():
        value = _at(settings, need)
        if isinstance(value, bool) or any(term.weight_in(settings.reward) for term in terms):
            continue
        names = " and ".join(term.setting for term in terms)
        fields = [f".{name}" for name in type(value).model_fields] if isinstance(value, BaseModel) else [""]
        reason = f"env.reward.{names} {'are' if len(terms) > 1 else 'is'} 0"
        unread |= {f"{need}{field}": reason for field in fields}
    return unread


def _at(settings: EnvSettings, dotted: str) -> Any:
    return reduce(getattr, dotted.split("."), settings)
