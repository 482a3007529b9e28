"""Restore an early-stopping rule by replaying its recorded evaluations."""

from collections.abc import Sequence

from msk_ray.experiment.outcomes import Ending
from msk_ray.experiment.scheduler_log import LogEntry
from msk_ray.sweep.rules.early_stopping import Pruner


def replay(pruner: Pruner, time_attr: str, reports: Sequence[LogEntry]) -> Ending | None:
    """Replay recorded evaluations.

    Returns:
        The rule's answer to the last evaluation; the driver may have died before carrying it out.
    """
    ending = None
    attempts: dict[str, int] = {}
    for report in reports:
        if report.attempt > attempts.setdefault(report.trial, report.attempt):
            attempts[report.trial] = report.attempt
            pruner.forget(report.trial)
        ending = pruner.report(report.trial, report.time(time_attr), report.score)
    return None if not reports or reports[-1].ended else ending
