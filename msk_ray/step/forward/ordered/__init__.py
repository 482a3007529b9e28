"""mujoco_warp's step with every sum in a fixed order, so that a GPU repeats it bit for bit.

The package counts contacts and constraint rows with atomics, so that threads that race decide on their order, and its
Newton solver adds squares and cone Hessians up with atomics. `DeterminismType.CONTACTS` and `CONSTRAINT` are bits that
mujoco_warp 4.0.0 knows and does nothing for: `_sort_contacts` and `_sort_constraints` are empty. Here contacts and rows
are sorted between its stages, the two sums of the solver have kernels of their own, and `ATOMICS` covers the rest.
"""

from msk_ray.step.forward.ordered.stages import OrderedStages, check_ordered

__all__ = ["OrderedStages", "check_ordered"]
