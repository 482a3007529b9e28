"""Learning algorithms, and what the trainer asks of one."""

from msk_ray.algorithms.base import Algorithm, EpochResult
from msk_ray.algorithms.shac import Shac

__all__ = ["Algorithm", "EpochResult", "Shac"]
