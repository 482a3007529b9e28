"""Operators over ranges of numbers."""

from dataclasses import dataclass

from msk_ray.sweep.operators.base import Range


@dataclass(frozen=True)
class Uniform(Range):
    """Every number is as likely as any other."""


@dataclass(frozen=True)
class LogUniform(Range):
    """Every order of magnitude is as likely as any other."""

    log = True


@dataclass(frozen=True)
class RandInt(Range):
    """Whole numbers, each as likely as any other."""

    whole = True
