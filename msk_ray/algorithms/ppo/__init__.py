"""Proximal Policy Optimization (Schulman et al. 2017, arXiv:1707.06347) by rsl-rl-lib."""

from msk_ray.algorithms.ppo.algorithm import Ppo

__all__ = ["Ppo"]
