"""Exact vector-Jacobian product of one mujoco_warp step, in Warp kernels of our own."""

from msk_ray.step.adjoint.step import StepAdjoint

__all__ = ["StepAdjoint"]
