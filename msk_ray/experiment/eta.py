"""Estimates how long an experiment will still take."""


def eta(running: list[tuple[int, float | None]], waiting: list[int], concurrent: int) -> float | None:
    """Seconds until all trials have run to their last epoch; an upper bound, because some are stopped earlier.

    Args:
        running: for each running trial its epochs left and its seconds per epoch, None while unknown.
        waiting: epochs of each trial not yet started.
        concurrent: number of trials that run at the same time.

    Returns:
        None while no speed is known.
    """
    known = [speed for _, speed in running if speed is not None]
    if not known:
        return None
    mean = sum(known) / len(known)
    # The longest first, each in the slot that becomes free first.
    slots = sorted(left * (speed if speed is not None else mean) for left, speed in running)
    slots = [0.0] * max(0, concurrent - len(slots)) + slots
    for epochs in sorted(waiting, reverse=True):
        slots[0] += epochs * mean
        slots.sort()
    return slots[-1]
