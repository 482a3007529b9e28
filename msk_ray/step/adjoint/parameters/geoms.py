"""Pose and size of geoms, through their contacts.

A contact follows a geom that is moved in its body as it follows the body: its wrench on the geom, about the geom's
centre, is the gradient of the pose. A change of size moves the feature that touches (face, edge, vertex, side, rim)
as a translation of the geom would, in a direction that depends on the feature only.
"""

from typing import Any

import warp as wp
from mujoco_warp import GeomType

from msk_ray.step.adjoint.groups import Contacts, GeomGradients, Shapes, Substep
from msk_ray.step.adjoint.parameters.base import ParameterFamily
from msk_ray.step.adjoint.spatial import column, quat_gradient
from msk_ray.step.adjoint.step import StepAdjoint

wp.set_module_options({"enable_backward": False})


@wp.func
def side_of(x: float) -> float:
    """1 or -1."""
    return wp.where(x < 0.0, -1.0, 1.0)


@wp.func
def size_slope(kind: int, size: wp.vec3, mat: wp.mat33, arm: wp.vec3, out: wp.vec3, force: wp.vec3) -> wp.vec3:
    """Slope of Φ by a geom's size.

    Args:
        kind: type of the geom.
        arm: of the point that touches, from the geom's centre.
        out: the contact's normal, away from the geom.
        force: slope of Φ along translations of the geom.
    """
    slope = wp.vec3(0.0)
    axis = column(mat, 2)
    if kind == GeomType.SPHERE or kind == GeomType.CAPSULE:
        # radius: the surface moves along the normal
        slope[0] = wp.dot(out, force)
    if kind == GeomType.CAPSULE or kind == GeomType.CYLINDER:
        # half length: the end or cap that touches moves along the axis, on which nothing else depends
        slope[1] = side_of(wp.dot(axis, arm)) * wp.dot(axis, force)
    if kind == GeomType.CYLINDER:
        across = arm - axis * wp.dot(axis, arm)
        if wp.length(across) > 0.0:
            slope[0] = wp.dot(wp.normalize(across), force)
    if kind == GeomType.BOX:
        for k in range(3):
            slope[k] = side_of(wp.dot(column(mat, k), arm)) * wp.dot(column(mat, k), force)
    if kind == GeomType.ELLIPSOID:
        # support point p = S² m / |S m| of the local normal m
        m = wp.transpose(mat) @ out
        local = wp.transpose(mat) @ force
        scaled = wp.cw_mul(size, m)
        reach = wp.length(scaled)
        point = wp.cw_mul(size, scaled) / reach
        for k in range(3):
            slope[k] = 2.0 * scaled[k] * local[k] / reach - wp.dot(point, local) * scaled[k] * m[k] / (reach * reach)
    return slope


@wp.kernel
def pull_geoms(
    # Model:
    shapes: Shapes,
    geom_quat: wp.array2d[wp.quat],
    # In:
    live_in: wp.array[int],
    nacon_in: wp.array[int],
    contacts_in: Contacts,
    contact_wrenches_in: wp.array2d[wp.spatial_vector],
    xmat_in: wp.array2d[wp.mat33],
    geom_xpos_in: wp.array2d[wp.vec3],
    geom_xmat_in: wp.array2d[wp.mat33],
    # Out:
    gradients_out: GeomGradients,
) -> None:
    """θ̄ -= ∂Φ/∂θ of the pose and size of one of a contact's two geoms."""
    con, side = wp.tid()
    if con >= wp.min(nacon_in[0], contacts_in.dist.shape[0]):
        return
    worldid = contacts_in.worldid[con]
    if contacts_in.efc_address[con, 0] < 0 or live_in[worldid] == 0:
        return
    geom = contacts_in.geom[con][side]
    mat = geom_xmat_in[worldid, geom]
    torque = wp.spatial_top(contact_wrenches_in[con, side])
    force = wp.spatial_bottom(contact_wrenches_in[con, side])
    wp.atomic_sub(
        gradients_out.geom_pos, worldid, geom, wp.transpose(xmat_in[worldid, shapes.geom_bodyid[geom]]) @ force
    )
    quat = geom_quat[worldid % geom_quat.shape[0], geom]
    wp.atomic_sub(gradients_out.geom_quat, worldid, geom, quat_gradient(quat, wp.transpose(mat) @ torque))
    # The normal leads from the first geom to the second, and the point is half way between both surfaces.
    away = float(1.0)
    if side == 1:
        away = -1.0
    out = away * contacts_in.frame[con][0]
    arm = contacts_in.pos[con] - 0.5 * contacts_in.dist[con] * out - geom_xpos_in[worldid, geom]
    size = shapes.geom_size[worldid % shapes.geom_size.shape[0], geom]
    wp.atomic_sub(
        gradients_out.geom_size, worldid, geom, size_slope(shapes.geom_type[geom], size, mat, arm, out, force)
    )


class GeomFamily(ParameterFamily):
    """Launches of the gradients of geoms' poses and sizes."""

    kinds = (GeomGradients,)

    def __init__(self, adjoint: StepAdjoint, gradients: dict[Any, Any]) -> None:
        super().__init__(adjoint, gradients)
        adjoint.contacts.keep_wrenches()

    def launch(self, at: Substep) -> None:
        self.work.launch(pull_geoms, (self.adjoint.contacts.count, 2), at, *self.gradients)
