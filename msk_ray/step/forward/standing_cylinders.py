"""Corrects contacts of cylinders with planes to those of C MuJoCo, for cylinders that stand almost upright.

The lowest point of a cylinder's rim is below the centre of its cap by the radius times the sine of its tilt.
mujoco_warp computes the sine from a difference of float32 numbers near one: at a tilt of 3e-4 rad it is all rounding,
and a contact is off by 3e-4 of the radius, the order of a usual penetration depth. And if the axis is upright up to
rounding, it uses the world's x axis instead of the cylinder's. `callback.contactfilter`, the public hook at the end of
collision detection, replaces distances and points, and adds missed contacts.
"""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from msk_ray.step.forward.arrays import gather
from msk_ray.step.forward.contact_records import ContactRecords, copy_contact
from msk_ray.step.forward.mjw_private import plane_cylinder

wp.set_module_options({"enable_backward": False})

_UPRIGHT = wp.constant(1.0e-12)
"""Sine of the tilt below which C MuJoCo takes the cylinder's x axis as the direction to its lowest point."""
_SIDE = wp.constant(0.8660254037844386)
"""√3 / 2: two contacts are a third of a turn away from the lowest one."""


class Points(wp.types.matrix(shape=(4, 3), dtype=float)):  # type: ignore[misc]
    """One point per row."""


@wp.func
def cylinder_on_plane(
    normal: wp.vec3, plane_pos: wp.vec3, pos: wp.vec3, mat: wp.mat33, radius: float, half: float
) -> tuple[wp.vec4, Points]:
    """Distances and points of the four contacts of a cylinder with a plane, in MuJoCo's order."""
    axis = wp.vec3(mat[0, 2], mat[1, 2], mat[2, 2])
    if wp.dot(normal, axis) > 0.0:
        axis = -axis
    across = wp.cross(axis, normal)
    sine = wp.length(across)
    lowest = wp.vec3(mat[0, 0], mat[1, 0], mat[2, 0])
    if sine >= _UPRIGHT:
        lowest = wp.cross(axis, across / sine)
    aside = (_SIDE * radius) * wp.cross(lowest, axis)
    lowest = radius * lowest
    height = wp.dot(pos - plane_pos, normal)
    near = height + half * wp.dot(axis, normal)
    far = height - half * wp.dot(axis, normal)
    sunk = radius * sine
    dist = wp.vec4(near - sunk, far - sunk, near + 0.5 * sunk, near + 0.5 * sunk)
    cap = pos + half * axis
    points = Points()
    points[0] = cap + lowest - (0.5 * dist[0]) * normal
    points[1] = pos - half * axis + lowest - (0.5 * dist[1]) * normal
    points[2] = cap + aside - 0.5 * lowest - (0.5 * dist[2]) * normal
    points[3] = cap - aside - 0.5 * lowest - (0.5 * dist[3]) * normal
    return dist, points


@wp.kernel
def correct_contacts(
    # Model:
    geom_type: wp.array[int],
    geom_size: wp.array2d[wp.vec3],
    gap: float,
    # In:
    found_in: wp.array[int],
    geom_xpos_in: wp.array2d[wp.vec3],
    geom_xmat_in: wp.array2d[wp.mat33],
    # Out:
    nacon_out: wp.array[int],
    contacts_out: ContactRecords,
    efc_address_out: wp.array2d[int],
) -> None:
    """One thread per contact; in each pair, the thread of the contact with the least distance adds missed contacts."""
    con = wp.tid()
    room = contacts_out.dist.shape[0]
    if con >= wp.min(found_in[0], room):
        return
    geoms = contacts_out.geom[con]
    if geoms[0] < 0 or geoms[1] < 0:  # a contact of a flex
        return
    if geom_type[geoms[0]] != mjw.GeomType.PLANE or geom_type[geoms[1]] != mjw.GeomType.CYLINDER:
        return
    worldid = contacts_out.worldid[con]
    k = contacts_out.geomcollisionid[con]
    plane = geom_xmat_in[worldid, geoms[0]]
    normal = wp.vec3(plane[0, 2], plane[1, 2], plane[2, 2])
    plane_pos = geom_xpos_in[worldid, geoms[0]]
    pos = geom_xpos_in[worldid, geoms[1]]
    mat = geom_xmat_in[worldid, geoms[1]]
    size = geom_size[worldid % geom_size.shape[0], geoms[1]]
    dist, points = cylinder_on_plane(normal, plane_pos, pos, mat, size[0], size[1])
    contacts_out.dist[con] = dist[k]
    contacts_out.pos[con] = points[k]
    axis = wp.vec3(mat[0, 2], mat[1, 2], mat[2, 2])
    seen, _points, _normal = plane_cylinder(normal, plane_pos, pos, axis, size[0], size[1])
    least = wp.where(seen[1] < seen[0], 1, 0)
    for i in range(2, 4):
        if seen[i] < seen[least]:
            least = i
    margin = contacts_out.includemargin[con]
    if k == least:
        for i in range(4):
            if dist[i] < margin and seen[i] >= margin + gap:
                added = wp.atomic_add(nacon_out, 0, 1)
                if added < room:
                    copy_contact(contacts_out, con, contacts_out, added)
                    contacts_out.dist[added] = dist[i]
                    contacts_out.pos[added] = points[i]
                    contacts_out.geomcollisionid[added] = i
                    for row in range(efc_address_out.shape[1]):
                        efc_address_out[added, row] = -1


class StandingCylinders:
    """Launches the correction, for models with planes and cylinders.

    Args:
        mjm: the MjModel.
    """

    def __init__(self, mjm: mujoco.MjModel) -> None:
        self._gap = float(max(2.0 * np.max(mjm.geom_gap, initial=0.0), np.max(mjm.pair_gap, initial=0.0)))
        self._found = wp.zeros(1, dtype=int)

    def launch(self, model: Any, data: Any) -> None:
        """Launch the correction on the contacts of collision detection."""
        wp.copy(self._found, data.nacon)
        wp.launch(
            correct_contacts,
            dim=data.naconmax,
            inputs=[model.geom_type, model.geom_size, self._gap, self._found, data.geom_xpos, data.geom_xmat],
            outputs=[data.nacon, gather(ContactRecords, data.contact), data.contact.efc_address],
        )


def has_cylinders_and_planes(mjm: mujoco.MjModel) -> bool:
    """Whether a model has both planes and cylinders."""
    types = set(np.asarray(mjm.geom_type).tolist())
    return {int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)} <= types
