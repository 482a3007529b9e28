"""Rollout length: constant, by schedule, or adapted to what a trial measures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, PositiveFloat, TypeAdapter, model_validator

from msk_ray.config.schedules import ramp
from msk_ray.config.sections import Count, Section
from msk_ray.errors import ConfigError, brief


class HorizonSchedule(Section):
    """Rollout length that changes linearly from `start` at epoch 0 to `end` at epoch `epochs`, and stays there."""

    kind: Literal["schedule"] = "schedule"
    start: Count
    end: Count
    epochs: Count

    def at(self, epoch: int) -> int:
        """Env steps at `epoch`, counted from 0."""
        return round(ramp(self.start, self.end, epoch, self.epochs))


class _BoundedHorizon(Section):
    start: Count
    shortest: Count = 4
    longest: Count = 64

    @model_validator(mode="after")
    def _bounds(self) -> _BoundedHorizon:
        if not self.shortest <= self.start <= self.longest:
            raise ValueError(
                f"shac.horizon: start {self.start} must be between shortest {self.shortest} and longest {self.longest}"
            )
        return self


class AdaptiveHorizon(_BoundedHorizon):
    """Rollout length that follows the gradient: longer while cotangents stay small, shorter when they grow.

    After each epoch H ← H (target / p90)^0.1 within bounds, where p90 is the 90th percentile of the state cotangents'
    norms in units of reward. Adaptive horizons are the idea of AHAC (Georgiev et al. 2024, arXiv:2405.17784), which
    follows a constraint on contact forces; this one follows the cotangents themselves.
    """

    kind: Literal["adaptive"] = "adaptive"
    target: PositiveFloat
    """Target for the 90th percentile of the cotangent norms, before any bound [reward]."""


class ContactHorizon(_BoundedHorizon):
    """Rollout length that follows contact, as AHAC's does: longer while contact forces stay below `contact`.

    After each epoch φ ← φ + 0.1 (c / contact − 1), within ±1, and H ← H (1 − 0.1 φ) within bounds, where c is the
    root mean square, over worlds and steps, of the force of all contacts. φ is AHAC's multiplier of the constraint on
    contact (Georgiev et al. 2024, arXiv:2405.17784), which its code keeps equal for all steps of a rollout. AHAC
    divides forces by accelerations; here the mean square tells impacts from standing, because the mean force of any
    gait is the body's weight.
    """

    kind: Literal["contact"] = "contact"
    contact: PositiveFloat
    """Contact force c above which rollouts become shorter [weight of the body]; a body at rest has 1."""


HORIZONS: Mapping[str, type[Section]] = {
    "schedule": HorizonSchedule,
    "adaptive": AdaptiveHorizon,
    "contact": ContactHorizon,
}
"""Settings of a varying horizon, by kind."""


def horizon_class(kind: Any) -> type[Section]:
    """The settings of a kind of horizon.

    Raises:
        ConfigError: there is no such kind.
    """
    if kind not in HORIZONS:
        what = "missing" if kind is None else f"unknown kind {brief(kind)}"
        raise ConfigError(f"shac.horizon.kind: {what}; write one of {', '.join(HORIZONS)}, or a number as the horizon")
    return HORIZONS[kind]


def _read_horizon(value: Any) -> Any:
    if isinstance(value, Section):
        return value
    if not isinstance(value, Mapping):
        return _CONSTANT.validate_python(value)
    try:
        return horizon_class(value.get("kind")).model_validate(value)
    except ConfigError as error:
        raise ValueError(str(error)) from error


_CONSTANT: TypeAdapter[int] = TypeAdapter(Count)
Horizon = Annotated[int | HorizonSchedule | AdaptiveHorizon | ContactHorizon, BeforeValidator(_read_horizon)]
