"""Check gradients of a model against float64 central differences of C MuJoCo."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msk_ray.step.check.check import Comparison, GradientCheck, Limits, check_gradients
    from msk_ray.step.check.nonfinite import NonFinite
    from msk_ray.step.check.oracle import Linearization, Oracle, Point
    from msk_ray.step.check.states import STATE_KINDS, make_states

__all__ = [
    "STATE_KINDS",
    "Comparison",
    "GradientCheck",
    "Limits",
    "Linearization",
    "NonFinite",
    "Oracle",
    "Point",
    "check_gradients",
    "make_states",
]

_HOMES = {
    "check": ("Comparison", "GradientCheck", "Limits", "check_gradients"),
    "nonfinite": ("NonFinite",),
    "oracle": ("Linearization", "Oracle", "Point"),
    "states": ("STATE_KINDS", "make_states"),
}


def __getattr__(name: str) -> Any:
    """Load names on first use, so that the command can print before torch is loaded."""
    for home, names in _HOMES.items():
        if name in names:
            attribute = getattr(import_module(f"{__name__}.{home}"), name)
            globals()[name] = attribute
            return attribute
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
