"""The operators of a search space, by name."""

import difflib
from collections.abc import Mapping
from typing import Any

from msk_ray.config import Registry, resolve_class
from msk_ray.errors import ConfigError, brief
from msk_ray.sweep.operators.base import Level, NamedValues, Operator, Range

_HERE = "msk_ray.sweep.operators"
OPERATORS = Registry(
    "operator",
    "msk_ray.operators",
    {
        "grid": f"{_HERE}.lists:Grid",
        "choice": f"{_HERE}.lists:Choice",
        "uniform": f"{_HERE}.ranges:Uniform",
        "loguniform": f"{_HERE}.ranges:LogUniform",
        "randint": f"{_HERE}.ranges:RandInt",
    },
)

__all__ = ["OPERATORS", "Level", "NamedValues", "Operator", "Range", "parse_operator"]


def parse_operator(key: str, data: Any) -> Operator:
    """Parse a parameter's operator: a short name or `package.module:Class`, and its values.

    Raises:
        ConfigError: unknown operator, empty list, or values that do not fit.
    """
    if not isinstance(data, Mapping) or len(data) != 1:
        raise ConfigError(
            f"parameters.{key}: write one of {', '.join(OPERATORS.known())}, such as {{grid: [1, 2]}}, not "
            f"{brief(data)}"
        )
    kind, values = next(iter(data.items()))
    path = kind if isinstance(kind, str) and ":" in kind else OPERATORS.find(str(kind))
    if path is None:
        near = difflib.get_close_matches(str(kind), OPERATORS.known(), n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(OPERATORS.known())}"
        raise ConfigError(f"parameters.{key}: unknown operator {brief(kind)}; {hint}")
    where = f"parameters.{key}.{kind}"
    if not isinstance(values, list) or not values:
        raise ConfigError(f"{where}: must be a list, not {brief(values)}")
    # mypy does not accept an abstract class as type[T].
    operator: type[Operator] = resolve_class(path, f"parameters.{key}", Operator)  # type: ignore[type-abstract]
    return operator.parse(where, values)
