"""Learning algorithms and their interface to the trainer. Each is loaded only when it is named."""

from msk_ray.algorithms.base import Algorithm, EpochResult, algorithm_class

__all__ = ["Algorithm", "EpochResult", "algorithm_class"]
