"""Values that change over training. Pure functions of the epoch, counted from 0."""

import math

from msk_ray.config import AdaptiveHorizon, ContactHorizon
from msk_ray.config.schedules import ramp

ADAPTATION = 0.1
"""Exponent, or share, by which a horizon that follows something changes in an epoch."""


def learning_rate_at(initial: float, final: float, schedule: str, epoch: int, epochs: int) -> float:
    """Learning rate at `epoch` of `epochs`: `initial` throughout, or linear towards `final`."""
    if schedule == "constant":
        return initial
    return ramp(initial, min(final, initial), epoch, epochs)


def adapted_horizon(config: AdaptiveHorizon, horizon: float, cotangent: float) -> float:
    """Next horizon, after an epoch at `horizon` (not rounded) with this 90th percentile of cotangent norms [reward].

    H ← H (target / p90)^ADAPTATION within bounds. A percentile that is not finite shrinks H by 2^ADAPTATION.
    """
    ratio = config.target / cotangent if math.isfinite(cotangent) and cotangent > 0.0 else 0.5
    return min(max(horizon * ratio**ADAPTATION, config.shortest), config.longest)


def contact_horizon(config: ContactHorizon, horizon: float, multiplier: float, contact: float) -> tuple[float, float]:
    """Next horizon and multiplier φ, after an epoch at `horizon` (not rounded) with this contact force [body weights].

    φ ← φ + ADAPTATION (contact / config.contact − 1) within ±1, then H ← H (1 − ADAPTATION·φ) within bounds.
    """
    multiplier = min(max(multiplier + ADAPTATION * (contact / config.contact - 1.0), -1.0), 1.0)
    return min(max(horizon * (1.0 - ADAPTATION * multiplier), config.shortest), config.longest), multiplier
