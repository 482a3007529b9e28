"""Checks gradients of a model against float64 central differences of C MuJoCo."""

from msk_ray.gradcheck.check import Comparison, GradientReport, Limits, check_gradients
from msk_ray.gradcheck.oracle import Linearization, Oracle, Point
from msk_ray.gradcheck.states import STATE_KINDS, make_states

__all__ = [
    "STATE_KINDS",
    "Comparison",
    "GradientReport",
    "Limits",
    "Linearization",
    "Oracle",
    "Point",
    "check_gradients",
    "make_states",
]
