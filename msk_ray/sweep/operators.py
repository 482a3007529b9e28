"""What a search space may write for a parameter: lists (`grid`, `choice`) and ranges (`uniform`, `loguniform`,
`randint`)."""

import difflib
import math
import random
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from msk_ray.errors import ConfigError, brief
from msk_ray.text import describe

ListKind = Literal["grid", "choice"]
RangeKind = Literal["uniform", "loguniform", "randint"]
KINDS = ("grid", "choice", "uniform", "loguniform", "randint")


@dataclass(frozen=True)
class Level:
    """One value of a parameter and the text tables show for it."""

    value: Any
    label: str


@dataclass(frozen=True)
class Listed:
    """Named values: `grid` tries each of them, `choice` draws one."""

    kind: ListKind
    levels: tuple[Level, ...]


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, both included."""

    kind: RangeKind
    low: float
    high: float

    def draw(self, rng: random.Random) -> Level:
        """One value. Rounded to 6 digits, so that tables, hashes and YAML all hold the same number."""
        if self.kind == "randint":
            number: float = rng.randint(int(self.low), int(self.high))
        elif self.kind == "uniform":
            number = _six_digits(rng.uniform(self.low, self.high))
        else:
            number = _six_digits(math.exp(rng.uniform(math.log(self.low), math.log(self.high))))
        return Level(self.clip(number), f"{number:g}")

    def clip(self, number: float) -> float:
        """The nearest value inside the range; whole for `randint`."""
        inside = min(max(number, self.low), self.high)
        return round(inside) if self.kind == "randint" else inside

    def ends(self) -> tuple[Level, Level]:
        """Both ends, which must themselves be valid settings."""
        low, high = self.clip(self.low), self.clip(self.high)
        return Level(low, f"{low:g}"), Level(high, f"{high:g}")


Operator = Listed | Range


def parse_operator(key: str, data: Any) -> Operator:
    """The operator written for parameter `key`.

    Raises:
        ConfigError: unknown operator, empty list, or a range that is none.
    """
    if not isinstance(data, Mapping) or len(data) != 1:
        raise ConfigError(
            f"parameters.{key}: write one of {', '.join(KINDS)}, such as {{grid: [1, 2]}}, not {brief(data)}"
        )
    kind, values = next(iter(data.items()))
    if kind not in KINDS:
        near = difflib.get_close_matches(str(kind), KINDS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(KINDS)}"
        raise ConfigError(f"parameters.{key}: unknown operator {brief(kind)}; {hint}")
    if not isinstance(values, list) or not values:
        raise ConfigError(f"parameters.{key}.{kind}: must be a list, not {brief(values)}")
    if kind in ("grid", "choice"):
        return Listed(kind, tuple(_level(value) for value in values))
    return _range(key, kind, values)


def _level(value: Any) -> Level:
    if isinstance(value, Mapping) and set(value) == {"label", "value"}:
        return Level(value["value"], str(value["label"]))
    return Level(value, describe(value))


def _range(key: str, kind: RangeKind, values: list[Any]) -> Range:
    where = f"parameters.{key}.{kind}"
    numbers = [number for number in map(_number, values) if number is not None]
    if len(values) != 2 or len(numbers) != 2:
        raise ConfigError(f"{where}: write [low, high], two numbers, not {brief(values)}")
    low, high = numbers
    if not low < high:
        raise ConfigError(f"{where}: low {low:g} must be below high {high:g}")
    if kind == "loguniform" and low <= 0:
        raise ConfigError(f"{where}: low {low:g} must be above 0")
    if kind == "randint" and not (isinstance(low, int) and isinstance(high, int)):
        raise ConfigError(f"{where}: both ends must be whole numbers, not {brief(values)}")
    return Range(kind, low, high)


def _number(value: Any) -> int | float | None:
    """`value` as a number below 2^53 in size, or None. YAML reads 1e-3 as text (it wants 1.0e-3), so text is tried
    too."""
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
