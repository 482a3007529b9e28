"""Check gradients of a model against float64 central differences of C MuJoCo."""

from msk_ray.gradcheck.chain import ChainComparison, check_chain
from msk_ray.gradcheck.check import Comparison, GradientCheck, Limits, check_gradients
from msk_ray.gradcheck.nonfinite import NonFinite
from msk_ray.gradcheck.oracle import Linearization, Oracle, Point
from msk_ray.gradcheck.states import STATE_KINDS, make_states

__all__ = [
    "STATE_KINDS",
    "ChainComparison",
    "Comparison",
    "GradientCheck",
    "Limits",
    "Linearization",
    "NonFinite",
    "Oracle",
    "Point",
    "check_chain",
    "check_gradients",
    "make_states",
]
