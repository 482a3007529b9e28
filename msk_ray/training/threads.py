"""Torch's threads on the CPU: as many as a trial's settings say, whatever the machine has.

By default torch takes one for each core, and those that wait for work spin. On a machine that computes something else
too, small networks then take many times as long; and sums over another number of parts round differently.
"""

import torch

from msk_ray.config import Config


def use_threads(config: Config) -> None:
    """Have torch compute with `trial.threads` threads, in this whole process."""
    torch.set_num_threads(config.trial.threads)
