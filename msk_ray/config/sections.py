"""The base classes and types of all groups of settings."""

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, ClassVar, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PrivateAttr, field_validator, model_validator
from pydantic_core import PydanticCustomError

from msk_ray.config.terms import Term, check_switches

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(gt=0, lt=2**31)]
"""A count of at least one, within the range of Warp and CUDA."""
Whole = Annotated[int, Field(ge=0, lt=2**31)]
"""A whole number of at least 0."""
Rate = Annotated[float, Field(ge=1e-10, le=100.0)]
"""A learning rate. A smaller one would not change float32 weights."""
Text = Annotated[str, Field(max_length=4096)]
SMALLEST, LARGEST = 1e-30, 1e30
"""Range of the magnitude of numbers other than 0, so that results fit into float32."""


SHOWN = "shown"
"""Validation context for settings that are only displayed: a class that cannot be found is then no error."""


class Section(BaseModel):
    """A frozen group of settings. Refuses unknown keys, `true` where a number is expected, and numbers that are not
    finite or outside `SMALLEST` to `LARGEST`."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _no_truth_for_numbers(cls, data: Any) -> Any:
        # Pydantic accepts True as 1. Replace it before conversion by something that is not a number.
        if not isinstance(data, dict):
            return data
        numeric = _without_truth(cls)
        return {key: _no_number(value) if key in numeric else value for key, value in data.items()}

    @field_validator("*")
    @classmethod
    def _of_sensible_size(cls, value: Any) -> Any:
        if not _sensible(value):
            text = "Input should be 0 or between {smallest:g} and {largest:g} in size"
            raise PydanticCustomError("size", text.format(smallest=SMALLEST, largest=LARGEST))
        return value


class _NotANumber:
    """Placeholder for a `true` or `false` that is not allowed, until validation refuses it."""

    def __init__(self, value: bool) -> None:
        self._value = value

    def __repr__(self) -> str:
        return str(self._value).lower()


def _sensible(value: Any) -> bool:
    if isinstance(value, float):
        return value == 0.0 or SMALLEST <= abs(value) <= LARGEST
    return all(map(_sensible, value)) if isinstance(value, list | tuple) else True


def _no_number(value: Any) -> Any:
    if isinstance(value, bool):
        return _NotANumber(value)
    if isinstance(value, list | tuple) and any(isinstance(item, bool) for item in value):
        return [_no_number(item) for item in value]
    return value


@cache
def _without_truth(section: type[Section]) -> frozenset[str]:
    """Fields that accept neither true nor false."""
    return frozenset(name for name, field in section.model_fields.items() if not _takes_truth(field.annotation))


def _takes_truth(annotation: Any) -> bool:
    # A Literal may contain True or False, for a word such as `off` that YAML reads as false.
    return (
        annotation in (bool, Any)
        or isinstance(annotation, bool)
        or any(_takes_truth(part) for part in get_args(annotation))
    )


class Undeclared(Section):
    """Recorded settings of a class that is not installed here, enough to display their trials.

    Must be the last base class, because that one decides whether unknown keys are accepted.
    """

    model_config = ConfigDict(extra="allow")

    _why: str = PrivateAttr("")

    @classmethod
    def because(cls, why: str, settings: Any) -> Self:
        """The settings, with the reason why their class cannot be found."""
        section = cls.model_validate(settings)
        section._why = why
        return section

    @property
    def why(self) -> str:
        """Why their class cannot be found."""
        return self._why


class Reward(Section):
    """Weights and shapes of an environment's reward. The defaults are the reference reward: policies are scored under
    it, whatever reward they were trained with."""

    terms: ClassVar[tuple[Term, ...]] = ()
    """The terms whose weights it has; empty if its environment computes them in one method."""
    without_weights: ClassVar[type["Reward"]]
    """The section without the weights of its terms, if it has any."""


class EnvSettings(Section):
    """Settings that every environment has, and facts that its class declares."""

    variants: ClassVar[tuple[str, ...]] = ()
    """Named physics of the environment; policies are scored under the first."""
    pyramidal_variants: ClassVar[frozenset[str]] = frozenset()
    """The named physics with a pyramidal friction cone, unless `physics.cone` is set."""
    reads_physics: ClassVar[frozenset[str]]
    """Dotted settings of the physics section that it uses, such as `fd.eps_act`; others are refused."""

    conditions: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Harder conditions for evaluating policies: name → dotted settings of the config."""

    name: Text
    """The environment: a short name, or package.module:Class."""
    nworld: Count = 64
    """Number of worlds W."""
    episode_length: Count
    """Env steps after which an episode is truncated."""
    control_timestep: PositiveFloat = 1.0 / 60.0
    """Duration of an env step [s]."""
    stochastic_reset: bool = True
    """Draw random initial states; false: start every episode in the same state."""
    spread_resets: bool = False
    """Start training with episode ages spread over `episode_length`; otherwise all worlds that do not fall reset at the
    same time. Evaluations always start at age 0."""
    reward: Reward = Reward()

    def check_installed(self) -> None:
        """Raise if packages or files that the environment needs are not on this machine.

        Raises:
            ConfigError: the message names what to install.
        """

    def unread(self) -> dict[str, str]:
        """Dotted settings of this section that have no effect because of others → the reason.

        Without those that terms of the reward need.
        """
        return {}

    @model_validator(mode="after")
    def _switches_of_terms(self) -> Self:
        check_switches(self)
        return self
