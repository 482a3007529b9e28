"""Where a trial's rows go: always to `metrics.jsonl` first, then to the loggers that `execution.loggers` names."""

from msk_ray.training.loggers.base import Logger
from msk_ray.training.loggers.trial_log import TrialLog

__all__ = ["Logger", "TrialLog"]
