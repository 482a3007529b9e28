"""Values that change over training. Pure functions of the epoch, counted from 0."""

from msk_ray.config import HorizonSchedule


def horizon_at(schedule: int | HorizonSchedule, epoch: int) -> int:
    """Rollout length H in env steps at `epoch`."""
    return schedule if isinstance(schedule, int) else schedule.at(epoch)


def learning_rate_at(initial: float, final: float, schedule: str, epoch: int, epochs: int) -> float:
    """Learning rate at `epoch` of `epochs`: `initial` throughout, or linear towards `final`."""
    if schedule == "constant":
        return initial
    return initial + (min(final, initial) - initial) * min(1.0, epoch / epochs)
