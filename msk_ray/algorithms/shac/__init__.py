"""Short-Horizon Actor-Critic (Xu et al. 2022, arXiv:2204.07137)."""

from msk_ray.algorithms.shac.algorithm import Shac

__all__ = ["Shac"]
