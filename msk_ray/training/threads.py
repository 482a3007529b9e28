"""Number of torch's CPU threads: set by the trial, not by the machine.

By default torch uses one thread per core, and idle threads spin. On a busy machine small networks then take many times
as long. The number of threads also changes rounding, because sums are split among them.
"""

import torch

from msk_ray.config import Config


def use_threads(config: Config) -> None:
    """Make torch use `execution.threads` threads in this process."""
    torch.set_num_threads(config.execution.threads)
