"""Forces that contacts exert on geoms, as the solver found them in the last substep. Values only: no gradient.

Axes: W worlds, G geoms.
"""

from typing import Any

import mujoco_warp as mjw
import numpy as np
import warp as wp


@wp.kernel(enable_backward=False)
def sum_by_geom(
    # Data in:
    nacon_in: wp.array[int],
    contact_worldid_in: wp.array[int],
    contact_geom_in: wp.array[wp.vec2i],
    # In:
    force_in: wp.array[wp.spatial_vector],
    # Out:
    force_out: wp.array2d[wp.vec3],
) -> None:
    """Adds each contact's force to the second geom of its pair, and its opposite to the first."""
    contactid = wp.tid()
    if contactid >= nacon_in[0]:
        return
    worldid = contact_worldid_in[contactid]
    geoms = contact_geom_in[contactid]
    force = wp.spatial_top(force_in[contactid])
    wp.atomic_add(force_out, worldid, geoms[1], force)
    wp.atomic_sub(force_out, worldid, geoms[0], force)


class ContactForces:
    """Sums contact forces by geom.

    Args:
        model, data: a batch's, after a step: the contacts belong to the state before its last substep.

    Attributes:
        force: force on each geom in world coordinates [N], vec3, shape (W, G).
    """

    def __init__(self, model: Any, data: Any) -> None:
        self._model, self._data = model, data
        with wp.ScopedDevice(data.qpos.device):
            self._ids = wp.array(np.arange(data.naconmax, dtype=np.int32), dtype=int)
            self._wrenches = wp.zeros(data.naconmax, dtype=wp.spatial_vector)
            self.force = wp.zeros((data.nworld, model.ngeom), dtype=wp.vec3)

    def launch(self) -> None:
        """Launch the computation of `force` from the contacts in `data`."""
        data = self._data
        with wp.ScopedDevice(data.qpos.device):
            self.force.zero_()
            mjw.contact_force(self._model, data, self._ids, True, self._wrenches)
            wp.launch(
                sum_by_geom,
                dim=data.naconmax,
                inputs=[data.nacon, data.contact.worldid, data.contact.geom, self._wrenches],
                outputs=[self.force],
            )
