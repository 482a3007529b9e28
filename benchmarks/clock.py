"""Median time of an env step. Imports nothing of the package: mjlab's Python uses it too."""

import statistics
import time
from collections.abc import Callable

import torch

ROUNDS = 3


def milliseconds(step: Callable[[], object], device: torch.device, repeats: int) -> float:
    """Median over the rounds of a step's time [ms], each the mean of `repeats` steps; one more comes before them."""

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    step()
    taken = []
    for _ in range(ROUNDS):
        begin = now()
        for _ in range(repeats):
            step()
        taken.append(1e3 * (now() - begin) / repeats)
    return statistics.median(taken)
