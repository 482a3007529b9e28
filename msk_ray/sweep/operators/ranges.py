"""Operators over ranges of numbers."""

from dataclasses import dataclass

from msk_ray.sweep.operators.base import Range


@dataclass(frozen=True)
class Uniform(Range):
    """Uniform distribution of numbers."""


@dataclass(frozen=True)
class LogUniform(Range):
    """Log-uniform distribution of numbers."""

    log = True


@dataclass(frozen=True)
class RandInt(Range):
    """Uniform distribution of whole numbers."""

    whole = True
