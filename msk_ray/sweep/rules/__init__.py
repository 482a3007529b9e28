"""Rules that end trials before their last epoch: by a trial's own history, or by comparing trials.

Each is a class with its settings, in a separate file. Pure: no Ray, no files, no clock.
"""

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationInfo

from msk_ray.config import Registry, resolve_class
from msk_ray.errors import ConfigError
from msk_ray.sweep.rules.scheduler import SchedulerSpec

_HERE = "msk_ray.sweep.rules"
SCHEDULERS = Registry(
    "scheduler.kind",
    "msk_ray.schedulers",
    {
        "asha": f"{_HERE}.asha:Asha",
        "median": f"{_HERE}.median:Median",
        "pbt": f"{_HERE}.population:PopulationBasedTraining",
        "none": f"{_HERE}.scheduler:NoScheduler",
    },
)
RECORDED = {"recorded": True}
"""Validation context for a space recorded by an experiment."""
_SHARED = frozenset({"time_attr", "grace", "reduction", "min_trials", "interval", "quantile", "resample"})
"""Settings that older versions recorded for every rule, used or not; null meant a rule's default."""


def scheduler_class(name: Any) -> type[SchedulerSpec]:
    """The class of a rule by name or import path; None means `none`.

    Raises:
        ConfigError: there is none.
    """
    return resolve_class(SCHEDULERS.path("none" if name is None else name), "scheduler.kind", SchedulerSpec)


def read_scheduler(value: Any, info: ValidationInfo) -> Any:
    """Validate the section with its rule's class. In a recorded section, unused settings of other rules are dropped."""
    if isinstance(value, SchedulerSpec) or not isinstance(value, Mapping):
        return value
    try:
        kind = scheduler_class(value.get("kind"))
    except ConfigError as error:
        raise ValueError(str(error)) from error
    if info.context == RECORDED:
        unread = {key for key in _SHARED if key not in kind.model_fields or value.get(key) is None}
        value = {key: setting for key, setting in value.items() if key not in unread}
        if value.get("kind") == "none":
            value.pop("time_attr", None)
    return kind.model_validate(value)
