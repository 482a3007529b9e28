"""A solver for small models: one kernel, in which each warp runs all Newton iterations of its world.

mujoco_warp's solver launches nine kernels per iteration, and as many iterations as the slowest world needs.
"""

from msk_ray.step.forward.fused.solver import FusedSolver, check_fused, choose_fused

__all__ = ["FusedSolver", "check_fused", "choose_fused"]
