"""`evaluate --vary`: one policy with several values of a parameter of the model."""

import math
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from msk_ray.config import ModelRandomization, RandomizeConfig
from msk_ray.errors import ConfigError, brief
from msk_ray.text_table import text_table

HELP = (
    "evaluate with the model unchanged, and with each of these values of one field: geom_friction=0.4,0.8,1.2, or "
    "multiples of the model's values: body_mass=0.8x,1.2x"
)


def parse_vary(text: str) -> list[RandomizeConfig]:
    """One section `physics.randomize` for each value of `--vary`, with the field at that value.

    Raises:
        ConfigError: there is no such field, or a value is not a positive number.
    """
    name, equals, values = text.partition("=")
    known = list(ModelRandomization.model_fields)
    if not equals or name not in known:
        raise ConfigError(f"--vary {brief(text)}: write FIELD=VALUE,VALUE with one of {', '.join(known)}")
    return [_at(name, value.strip()) for value in values.split(",")]


def _at(name: str, value: str) -> RandomizeConfig:
    """A section with one field at one value, such as "0.8", or at a multiple, such as "0.8x"."""
    scale = value.endswith("x")
    try:
        number = float(value.removesuffix("x"))
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0.0):
        raise ConfigError(f"--vary {name}: {brief(value)} is no positive number; write 0.8, or 0.8x for a multiple")
    try:
        return RandomizeConfig.model_validate(
            {name: {"low": number, "high": number, "mode": "scale" if scale else "value"}}
        )
    except ValidationError:
        raise ConfigError(f"--vary {name}: only multiples of the model's own; write {number:g}x") from None


def vary_text(entries: Sequence[dict[str, Any]]) -> str:
    """Evaluations of one policy with the unchanged model and with other values, for a terminal.

    Args:
        entries: entries of `eval.json`; the first is with the unchanged model.
    """
    unchanged, outcomes = entries[0]["score"]["mean"], list(entries[0]["outcomes"])
    rows = [
        (
            entry["physics"],
            f"{entry['score']['mean']:.5g}",
            f"{entry['score']['std']:.3g}",
            f"{entry['score']['mean'] / unchanged:.0%}" if unchanged > 0.0 else "-",
            f"{entry['length']['mean']:.0f}",
            f"{entry['fall_rate']:.0%}",
            *(f"{entry['outcomes'][name]['mean']:.3g}" for name in outcomes),
        )
        for entry in entries
    ]
    return text_table(("physics", "score", "std", "of its own", "length", "fell", *outcomes), rows, 120)
