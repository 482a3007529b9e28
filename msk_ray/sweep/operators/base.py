"""The operators of a search space, which say what values of a parameter are tried.

To write your own operator, derive a class from `Operator`, `NamedValues` or `Range`. A space names it by its import
path: `{"package.module:Class": [...]}`.
"""

import math
import random
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from msk_ray.errors import ConfigError, brief
from msk_ray.text import describe


@dataclass(frozen=True)
class Level:
    """One value of a parameter, and how tables show it."""

    value: Any
    label: str


class Operator(ABC):
    """The values of one parameter."""

    enumerated: ClassVar[bool] = False
    """Whether every level is tried; if not, one is drawn for each trial."""
    levels: tuple[Level, ...]
    """All values, if they are enumerated."""

    @classmethod
    @abstractmethod
    def parse(cls, where: str, values: list[Any]) -> Self:
        """Parse the values in a space.

        Args:
            where: the key in the space, for errors.
            values: not empty.

        Raises:
            ConfigError: the values are invalid.
        """

    @abstractmethod
    def draw(self, rng: random.Random) -> Level:
        """A random value."""

    @abstractmethod
    def extremes(self) -> tuple[Level, ...]:
        """Levels among which is the one that makes a trial longest. The first one is used where the parameter does not
        matter."""

    def check(self) -> tuple[Level, ...]:
        """Levels to validate in advance: if they are valid settings, so is every draw."""
        return ()

    def recorded(self, written: Any) -> Level:
        """The level that a search has chosen, from its record."""
        return Level(written, describe(written))


@dataclass(frozen=True)
class NamedValues(Operator):
    """A list of values, each with a label."""

    levels: tuple[Level, ...]

    @classmethod
    def parse(cls, where: str, values: list[Any]) -> Self:
        return cls(tuple(_level(value) for value in values))

    def draw(self, rng: random.Random) -> Level:
        return rng.choice(self.levels)

    def extremes(self) -> tuple[Level, ...]:
        return self.levels

    def recorded(self, written: Any) -> Level:
        """The level with this label, because a search chooses among labels."""
        level = next((known for known in self.levels if known.label == written), None)
        return super().recorded(written) if level is None else level


@dataclass(frozen=True)
class Range(Operator):
    """Numbers from `low` to `high`, both included."""

    log: ClassVar[bool] = False
    """Whether it is spread evenly over orders of magnitude."""
    whole: ClassVar[bool] = False
    """Whether it holds only whole numbers."""

    low: float
    high: float

    @classmethod
    def parse(cls, where: str, values: list[Any]) -> Self:
        numbers = [number for number in map(_number, values) if number is not None]
        if len(values) != 2 or len(numbers) != 2:
            raise ConfigError(f"{where}: write [low, high], two numbers, not {brief(values)}")
        low, high = numbers
        if not low < high:
            raise ConfigError(f"{where}: low {low:g} must be below high {high:g}")
        if cls.log and low <= 0:
            raise ConfigError(f"{where}: low {low:g} must be above 0")
        if cls.whole and not (isinstance(low, int) and isinstance(high, int)):
            raise ConfigError(f"{where}: both ends must be whole numbers, not {brief(values)}")
        return cls(low, high)

    def draw(self, rng: random.Random) -> Level:
        """A random value, rounded to 6 digits so that tables, hashes and YAML hold the same number."""
        if self.whole:
            number: float = rng.randint(int(self.low), int(self.high))
        elif self.log:
            number = _six_digits(math.exp(rng.uniform(math.log(self.low), math.log(self.high))))
        else:
            number = _six_digits(rng.uniform(self.low, self.high))
        return Level(self.clip(number), describe(number))

    def clip(self, number: float) -> float:
        """The nearest value inside the range."""
        inside = min(max(number, self.low), self.high)
        return round(inside) if self.whole else inside

    def extremes(self) -> tuple[Level, ...]:
        """Both ends."""
        low, high = self.clip(self.low), self.clip(self.high)
        return Level(low, describe(low)), Level(high, describe(high))

    def check(self) -> tuple[Level, ...]:
        return self.extremes()


def _level(value: Any) -> Level:
    if isinstance(value, Mapping) and set(value) == {"label", "value"}:
        return Level(value["value"], str(value["label"]))
    return Level(value, describe(value))


def _number(value: Any) -> int | float | None:
    """`value` as a number of magnitude below 2^53, or None. Accepts text too, because YAML reads 1e-3 as text (it wants
    1.0e-3)."""
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 2**53:
        return None
    return value


def _six_digits(number: float) -> float:
    return float(f"{number:.6g}")
