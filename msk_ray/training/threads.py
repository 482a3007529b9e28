"""Torch's threads on the CPU: their number comes from the trial's settings, whatever the machine has.

By default torch uses one per core, and threads that wait for work spin. On a machine that is also busy with something
else, small networks then take many times as long; and sums over a different number of parts round differently.
"""

import torch

from msk_ray.config import Config


def use_threads(config: Config) -> None:
    """Make torch use `execution.threads` threads in this process."""
    torch.set_num_threads(config.execution.threads)
