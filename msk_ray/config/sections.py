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
"""A learning rate. A smaller one would change no weight that is kept in float32."""
Text = Annotated[str, Field(max_length=4096)]
SMALLEST, LARGEST = 1e-30, 1e30
"""Range of the size of numbers other than 0: what is computed from them has to fit into float32."""


SHOWN = "shown"
"""Context of validation of settings that are only shown: a class that cannot be found does not hide them."""


class Section(BaseModel):
    """A frozen group of settings that refuses unknown keys, `true` for a number, and numbers that are not finite or
    beyond `SMALLEST` and `LARGEST`."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _no_truth_for_numbers(cls, data: Any) -> Any:
        # Python accepts True as 1. Here, before any conversion, it is replaced by something that is not a number.
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
    """Stands for a `true` or `false` where neither is allowed, until it is refused."""

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
    # True and False may also be among a few values, as for a word that YAML reads as one of them.
    return (
        annotation in (bool, Any)
        or isinstance(annotation, bool)
        or any(_takes_truth(part) for part in get_args(annotation))
    )


class Undeclared(Section):
    """Recorded settings of a class that cannot be found here: enough to show the trials that had them.

    It is the last of several bases, which decides whether unknown keys are accepted.
    """

    model_config = ConfigDict(extra="allow")

    _why: str = PrivateAttr("")

    @classmethod
    def because(cls, why: str, settings: Any) -> Self:
        """The settings, and why their declaration cannot be found."""
        found = cls.model_validate(settings)
        found._why = why
        return found

    @property
    def why(self) -> str:
        """Why their declaration cannot be found."""
        return self._why


class Reward(Section):
    """The weights and shapes of an environment's reward. Their defaults are the reference reward, under which policies
    are scored whatever they were trained on."""

    terms: ClassVar[tuple[Term, ...]] = ()
    """The terms whose weights it has; empty if its environment computes them in one method."""
    without_weights: ClassVar[type["Reward"]]
    """The section without the weights of its terms, if it has any."""


class EnvSettings(Section):
    """The settings of every environment, and what it declares."""

    variants: ClassVar[tuple[str, ...]] = ()
    """Named physics of the environment; the first is the one that policies are scored under."""
    pyramidal_variants: ClassVar[frozenset[str]] = frozenset()
    """The named physics whose friction cone is a pyramid unless `physics.cone` says otherwise."""
    reads_physics: ClassVar[frozenset[str]]
    """Settings of the physics section that it reads, dotted if nested, such as `fd.eps_act`; others are refused."""

    conditions: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Harder circumstances that policies can be evaluated under, by name: dotted settings of the config."""

    name: Text
    """The environment: a short name, or package.module:Class."""
    nworld: Count = 64
    """Number of worlds W."""
    episode_length: Count
    """Env steps after which an episode is truncated."""
    control_timestep: PositiveFloat = 1.0 / 60.0
    """Duration of an env step [s]."""
    stochastic_reset: bool = True
    """Draw random initial states; False starts every episode in the same state."""
    spread_resets: bool = False
    """Begin training with episodes of ages spread over `episode_length`; otherwise all worlds that do not fall reset in
    the same env steps. Evaluations always begin at age 0."""
    reward: Reward = Reward()

    def check_installed(self) -> None:
        """Refuse an environment whose packages or files are not on this machine.

        Raises:
            ConfigError: the message names what to install.
        """

    def unread(self) -> dict[str, str]:
        """Settings of this section, dotted, that nothing reads because of others, and the reason for each.

        Those that terms of the reward need are not among them.
        """
        return {}

    @model_validator(mode="after")
    def _switches_of_terms(self) -> Self:
        check_switches(self)
        return self
