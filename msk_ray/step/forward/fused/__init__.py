"""A solver for small models: one kernel, in which a warp runs Newton's method of its world to the end.

mujoco_warp's solver launches nine kernels an iteration, and as many iterations as the slowest world needs.
"""

from msk_ray.step.forward.fused.solver import FusedSolver, check_fused

__all__ = ["FusedSolver", "check_fused"]
