"""Learning algorithms, and what the trainer asks of one. Each is loaded where it is named."""

from msk_ray.algorithms.base import Algorithm, EpochResult, algorithm_class

__all__ = ["Algorithm", "EpochResult", "algorithm_class"]
