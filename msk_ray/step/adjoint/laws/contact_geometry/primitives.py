"""How a contact's distance, point and frame move with the two bodies, by pair of geometries.

Plane against sphere, capsule, box or mesh: the core of the other geom that is nearest the plane (centre, end, corner,
vertex) is fixed to its body; against a cylinder it also runs around the rim. Sphere against sphere, capsule, cylinder
or box, capsule against capsule, and plane against ellipsoid: the collision function itself is differentiated
(`pair_laws`). Capsule against box: the law of the features that touch (`capsule_box`). All others: `convex`.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp
from mujoco_warp import GeomType

from msk_ray.step.adjoint.coverage.approximated import Touches, count_touch
from msk_ray.step.adjoint.groups import ContactBars, Contacts, Shapes
from msk_ray.step.adjoint.laws.contact_geometry.capsule_box import capsule_box_wrenches
from msk_ray.step.adjoint.laws.contact_geometry.contact_order import contacts_end
from msk_ray.step.adjoint.laws.contact_geometry.primitive_laws import (
    SCORED_PAIRS,
    STANDING_PAIRS,
    ParallelLaw,
    cores_coincide,
    is_convex_pair,
    is_scored,
    pair_score,
    parallel_law,
    rim_torque,
)
from msk_ray.step.adjoint.spatial import column, turning_torque, wrench
from msk_ray.step.forward.mjw_private import make_frame

wp.set_module_options({"enable_backward": False})


@wp.func
def frame_score(normal: wp.vec3, axis: wp.vec3, along_axis: wp.int32, weight: wp.mat33) -> wp.float32:
    """⟨weight, frame⟩ of the contact frame built from a normal, and from a capsule's axis where that guides it."""
    score = wp.float32(0.0)
    if along_axis == 1:
        b = wp.normalize(axis - normal * wp.dot(normal, axis))
        score = wp.dot(weight[0], normal) + wp.dot(weight[1], b) + wp.dot(weight[2], wp.cross(normal, b))
    elif along_axis == 2:
        # Steep capsule: a fixed second axis, not made orthogonal to the normal.
        score = wp.dot(weight[0], normal) + wp.dot(weight[1], axis) + wp.dot(weight[2], wp.cross(normal, axis))
    else:
        frame = make_frame(normal)
        score = wp.dot(weight[0], frame[0]) + wp.dot(weight[1], frame[1]) + wp.dot(weight[2], frame[2])
    return score


class PairKinds(NamedTuple):
    """Kinds of geometry pairs that a model can bring into contact; each costs compile time only where it occurs."""

    scored: bool
    """A pair that `pair_score` knows."""
    capsule_box: bool
    standing: bool
    """A cylinder and a plane."""

    @classmethod
    def of(cls, types: set[tuple[int, int]]) -> "PairKinds":
        """Those of a model whose colliding geometry types (ascending) are `types`."""
        return cls(
            bool(types & SCORED_PAIRS),
            (int(GeomType.CAPSULE), int(GeomType.BOX)) in types,
            bool(types & STANDING_PAIRS),
        )


@cache
def pull_geometry_kernel(kinds: PairKinds) -> Any:
    """The kernel for models with these kinds of pairs."""
    scored, capsule_box, standing = kinds

    @wp.kernel(module="unique", enable_backward=False)
    def pull_geometry(
        in_turn: bool,
        # Model:
        shapes: Shapes,
        substep: int,
        # In:
        nacon_in: wp.array[int],
        contacts_in: Contacts,
        geom_xpos_in: wp.array2d[wp.vec3],
        geom_xmat_in: wp.array2d[wp.mat33],
        subtree_com_in: wp.array2d[wp.vec3],
        contact_bars_in: ContactBars,
        # Out:
        moved_bar_out: wp.array2d[wp.spatial_vector],
        touches_out: Touches,
        wrenches_out: wp.array2d[wp.spatial_vector],
    ) -> None:
        """Cotangents of (dist, pos, frame) to wrenches on the two bodies whose displacement moves them."""
        start = wp.tid()
        for con in range(start, contacts_end(start, in_turn, nacon_in[0], contacts_in.worldid)):
            if contacts_in.efc_address[con, 0] < 0 and contact_bars_in.dist[con] == 0.0:
                continue
            worldid = contacts_in.worldid[con]
            geoms = contacts_in.geom[con]
            type1 = shapes.geom_type[geoms[0]]
            type2 = shapes.geom_type[geoms[1]]
            if is_convex_pair(type1, type2):
                continue
            body1 = shapes.geom_bodyid[geoms[0]]
            body2 = shapes.geom_bodyid[geoms[1]]
            dist = contacts_in.dist[con]
            point = contacts_in.pos[con]
            frame = contacts_in.frame[con]
            normal = frame[0]
            dist_bar = contact_bars_in.dist[con]
            pos_bar = contact_bars_in.pos[con]
            weight = contact_bars_in.frame[con]
            com1 = subtree_com_in[worldid, shapes.body_rootid[body1]]
            com2 = subtree_com_in[worldid, shapes.body_rootid[body2]]
            pos1 = geom_xpos_in[worldid, geoms[0]]
            pos2 = geom_xpos_in[worldid, geoms[1]]
            mat1 = geom_xmat_in[worldid, geoms[0]]
            mat2 = geom_xmat_in[worldid, geoms[1]]
            zero = wp.vec3(0.0)

            along_axis = int(0)
            axis = zero
            if type1 == GeomType.PLANE and type2 == GeomType.CAPSULE:
                axis = column(mat2, 2)
                along_axis = 1
                if wp.length(axis - normal * wp.dot(normal, axis)) < 0.5:
                    axis = frame[1]
                    along_axis = 2
            normal_bar, axis_bar, _kind, _weight = wp.grad(frame_score)(normal, axis, along_axis, weight)

            # Wrenches on the bodies: force at a point, and torque.
            force1 = zero
            torque1 = zero
            place1 = pos1
            force2 = zero
            torque2 = zero
            place2 = pos2
            known = bool(False)
            if wp.static(scored):
                known = is_scored(type1, type2)
            if wp.static(scored):
                if known:
                    size1 = shapes.geom_size[worldid % shapes.geom_size.shape[0], geoms[0]]
                    size2 = shapes.geom_size[worldid % shapes.geom_size.shape[0], geoms[1]]
                    law = ParallelLaw()
                    if type1 == GeomType.CAPSULE:
                        law = parallel_law(
                            contacts_in.geomcollisionid[con],
                            pos1,
                            column(mat1, 2),
                            size1[1],
                            pos2,
                            column(mat2, 2),
                            size2[1],
                        )
                    if cores_coincide(type1, type2, pos1, size1, pos2, size2, dist):
                        normal_bar = zero
                    _t1, _t2, pos1_bar, mat1_bar, _s1, pos2_bar, mat2_bar, _s2, _l, _d, _p, _n = wp.grad(pair_score)(
                        type1,
                        type2,
                        pos1,
                        mat1,
                        size1,
                        pos2,
                        mat2,
                        size2,
                        law,
                        dist_bar,
                        pos_bar,
                        normal_bar,
                    )
                    force1 = pos1_bar
                    force2 = pos2_bar
                    torque1 = turning_torque(mat1, mat1_bar)
                    torque2 = turning_torque(mat2, mat2_bar)
            if wp.static(capsule_box):
                if type1 == GeomType.CAPSULE and type2 == GeomType.BOX:
                    known = bool(True)
                    force1, torque1, force2, torque2 = capsule_box_wrenches(
                        contacts_in.geomcollisionid[con],
                        pos1,
                        mat1,
                        shapes.geom_size[worldid % shapes.geom_size.shape[0], geoms[0]],
                        pos2,
                        mat2,
                        shapes.geom_size[worldid % shapes.geom_size.shape[0], geoms[1]],
                        dist,
                        point,
                        normal,
                        dist_bar,
                        pos_bar,
                        normal_bar,
                    )
            if not known and type1 == GeomType.PLANE:
                # The core of the other geom that is nearest the plane is fixed to its body: a sphere's centre, a
                # capsule's end, a box's corner, a mesh's vertex; a cylinder's rim point also runs around the rim.
                radius = float(0.0)
                if type2 == GeomType.SPHERE or type2 == GeomType.CAPSULE:
                    radius = shapes.geom_size[worldid % shapes.geom_size.shape[0], geoms[1]][0]
                core = point + normal * (radius + 0.5 * dist)
                # pos = core - n (r + dist/2) ,  dist = n·(core - o) - r
                reach = dist_bar - 0.5 * wp.dot(normal, pos_bar)
                turned = normal_bar + reach * (core - pos1) - (radius + 0.5 * dist) * pos_bar
                force2 = pos_bar + reach * normal
                place2 = core
                if along_axis == 1:
                    torque2 = wp.cross(axis, axis_bar)
                # n turns with the plane: dn = ω × n  ⇒  torque n × n̄
                force1 = -reach * normal
                torque1 = wp.cross(normal, turned)
                if wp.static(standing):
                    if type2 == GeomType.CYLINDER:
                        around, exact = rim_torque(normal, column(mat2, 2), core - pos2, force2)
                        torque2 += around
                        torque1 -= around
                        if not exact and (dist_bar != 0.0 or wp.dot(pos_bar, pos_bar) != 0.0):
                            ngeom = shapes.geom_type.shape[0]
                            count_touch(touches_out, worldid, substep, ngeom, geoms[0], geoms[1], type1, type2)
            if wrenches_out.shape[0] > 0:
                wrenches_out[con, 0] = wrench(force1, torque1, place1 - pos1)
                wrenches_out[con, 1] = wrench(force2, torque2, place2 - pos2)
            if body1 > 0:
                wp.atomic_add(moved_bar_out, worldid, body1, wrench(force1, torque1, place1 - com1))
            if body2 > 0:
                wp.atomic_add(moved_bar_out, worldid, body2, wrench(force2, torque2, place2 - com2))

    return pull_geometry
