"""No trial is compared with others."""

from typing import Literal

from msk_ray.config.sections import Text
from msk_ray.sweep.rules.early_stopping import SchedulerSpec


class NoScheduler(SchedulerSpec):
    """Lets every trial run."""

    ends_trials = False

    kind: Text = "none"
    time_attr: Literal["env_steps"] = "env_steps"
