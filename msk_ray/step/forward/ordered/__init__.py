"""mujoco_warp's step with every sum in a fixed order, so that a GPU repeats it bit for bit.

mujoco_warp allocates contacts and constraint rows with atomics, so that racing threads decide their order, and its
Newton solver sums squares and cone Hessians with atomics. `DeterminismType.CONTACTS` and `CONSTRAINT` have no effect in
mujoco_warp 4.0.0: `_sort_contacts` and `_sort_constraints` are empty. Here contacts and rows are sorted between the
stages, the two sums of the solver have their own kernels, and `ATOMICS` covers the rest.
"""

from msk_ray.step.forward.ordered.stages import OrderedStages, check_ordered

__all__ = ["OrderedStages", "check_ordered"]
