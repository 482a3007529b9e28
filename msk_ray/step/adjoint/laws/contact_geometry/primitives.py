"""How a contact's distance, point and frame move with the two bodies, by pair of geometries.

Plane against sphere, capsule, box or mesh: the core of the other geom that is nearest the plane (centre, end, corner,
vertex) is fixed to its body; against a cylinder it also runs around the rim. Sphere against sphere, capsule, cylinder
or box, capsule against capsule, and plane against ellipsoid: the collision function itself is differentiated
(`primitive_laws`). Capsule against box: the law of the features that touch (`capsule_box`). All others: `convex`.

With o a point of the plane, n its normal, r the core's radius and c the core,

    dist = n·(c - o) - r ,  pos = c - n (r + dist/2) ,  frame = frame(n, the capsule's axis) .
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp
from mujoco_warp import GeomType

from msk_ray.step.adjoint.coverage.approximated import Touches, count_touch
from msk_ray.step.adjoint.groups import ContactBars, Contacts, FieldBars, Shapes
from msk_ray.step.adjoint.laws.contact_geometry.capsule_box import capsule_box_push
from msk_ray.step.adjoint.laws.contact_geometry.contact_order import contacts_end
from msk_ray.step.adjoint.laws.contact_geometry.contact_point import Bars, ContactPoint, Geom, PairPush
from msk_ray.step.adjoint.laws.contact_geometry.primitive_laws import (
    POTENTIAL_PAIRS,
    STANDING_PAIRS,
    ParallelLaw,
    cores_coincide,
    has_potential,
    is_convex_pair,
    pair_potential,
    parallel_law,
    rim_torque,
)
from msk_ray.step.adjoint.spatial import column, turning_torque, wrench
from msk_ray.step.forward.mjw_private import make_frame

wp.set_module_options({"enable_backward": False})


BUILT, ALONG_AXIS, BESIDE_AXIS = (wp.constant(i) for i in range(3))
"""Contact frames: built from the normal alone; with a capsule's axis, made orthogonal to the normal, as second axis;
with a fixed second axis, where the capsule is steep."""


@wp.struct
class FrameGuide:
    """What a contact's frame is built from besides its normal."""

    kind: wp.int32
    axis: wp.vec3


@wp.func
def frame_guide(plane: Geom, other: Geom, frame: wp.mat33) -> FrameGuide:
    """The guide of a pair, which has an axis where a capsule meets a plane."""
    out = FrameGuide()
    if plane.type == GeomType.PLANE and other.type == GeomType.CAPSULE:
        normal = frame[0]
        out.axis = column(other.mat, 2)
        out.kind = ALONG_AXIS
        if wp.length(out.axis - normal * wp.dot(normal, out.axis)) < 0.5:
            out.axis = frame[1]
            out.kind = BESIDE_AXIS
    return out


@wp.func
def frame_potential(normal: wp.vec3, guide: FrameGuide, weight: wp.mat33) -> wp.float32:
    """⟨weight, frame⟩ of the contact frame built from a normal and its guide."""
    axis = guide.axis
    potential = wp.float32(0.0)
    if guide.kind == ALONG_AXIS:
        b = wp.normalize(axis - normal * wp.dot(normal, axis))
        potential = wp.dot(weight[0], normal) + wp.dot(weight[1], b) + wp.dot(weight[2], wp.cross(normal, b))
    elif guide.kind == BESIDE_AXIS:
        potential = wp.dot(weight[0], normal) + wp.dot(weight[1], axis) + wp.dot(weight[2], wp.cross(normal, axis))
    else:
        frame = make_frame(normal)
        potential = wp.dot(weight[0], frame[0]) + wp.dot(weight[1], frame[1]) + wp.dot(weight[2], frame[2])
    return potential


@wp.func
def geom_of(worldid: int, geomid: int, shapes: Shapes, xpos: wp.array2d[wp.vec3], xmat: wp.array2d[wp.mat33]) -> Geom:
    """A geom of one world."""
    out = Geom()
    out.type = shapes.geom_type[geomid]
    out.pos = xpos[worldid, geomid]
    out.mat = xmat[worldid, geomid]
    out.size = shapes.geom_size[worldid % shapes.geom_size.shape[0], geomid]
    return out


@wp.func
def push_by_potential(index: int, geom1: Geom, geom2: Geom, contact: ContactPoint, bars: Bars) -> PairPush:
    """Push of contact `index` of a pair that `pair_potential` knows, at the geoms' centres."""
    law = ParallelLaw()
    if geom1.type == GeomType.CAPSULE:
        axis1 = column(geom1.mat, 2)
        axis2 = column(geom2.mat, 2)
        law = parallel_law(index, geom1.pos, axis1, geom1.size[1], geom2.pos, axis2, geom2.size[1])
    weights = bars
    if cores_coincide(geom1.type, geom2.type, geom1.pos, geom1.size, geom2.pos, geom2.size, contact.dist):
        weights.normal = wp.vec3(0.0)
    geom1_bar, geom2_bar, _law, _weights = wp.grad(pair_potential)(geom1, geom2, law, weights)
    out = PairPush()
    out.force1 = geom1_bar.pos
    out.torque1 = turning_torque(geom1.mat, geom1_bar.mat)
    out.place1 = geom1.pos
    out.force2 = geom2_bar.pos
    out.torque2 = turning_torque(geom2.mat, geom2_bar.mat)
    out.place2 = geom2.pos
    return out


@wp.func
def plane_push(
    plane: Geom, other: Geom, contact: ContactPoint, bars: Bars, guide: FrameGuide, axis_bar: wp.vec3
) -> PairPush:
    """Push of a plane and the geom whose nearest core is fixed to its body: c and o as above, acting at c and at o."""
    normal = contact.normal
    radius = float(0.0)
    if other.type == GeomType.SPHERE or other.type == GeomType.CAPSULE:
        radius = other.size[0]
    core = contact.point + normal * (radius + 0.5 * contact.dist)
    reach = bars.dist - 0.5 * wp.dot(normal, bars.point)
    out = PairPush()
    out.force2 = bars.point + reach * normal
    out.place2 = core
    if guide.kind == ALONG_AXIS:
        out.torque2 = wp.cross(guide.axis, axis_bar)
    # n turns with the plane: dn = ω × n  ⇒  torque n × n̄
    normal_bar = bars.normal + reach * (core - plane.pos) - (radius + 0.5 * contact.dist) * bars.point
    out.force1 = -reach * normal
    out.torque1 = wp.cross(normal, normal_bar)
    out.place1 = plane.pos
    return out


class PairKinds(NamedTuple):
    """Kinds of geometry pairs that a model can bring into contact; each costs compile time only where it occurs."""

    has_potential: bool
    """A pair that `pair_potential` knows."""
    capsule_box: bool
    standing: bool
    """A cylinder and a plane."""

    @classmethod
    def of(cls, types: set[tuple[int, int]]) -> "PairKinds":
        """The kinds in a model whose colliding geometry types (ascending) are `types`."""
        return cls(
            bool(types & POTENTIAL_PAIRS),
            (int(GeomType.CAPSULE), int(GeomType.BOX)) in types,
            bool(types & STANDING_PAIRS),
        )


@cache
def pull_geometry_kernel(kinds: PairKinds) -> Any:
    """The kernel for models with these kinds of pairs."""

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
        bars_out: FieldBars,
        touches_out: Touches,
        contact_wrenches_out: wp.array2d[wp.spatial_vector],
    ) -> None:
        """Cotangents of (dist, pos, frame) to wrenches on the two bodies whose displacement moves them."""
        start = wp.tid()
        for con in range(start, contacts_end(start, in_turn, nacon_in[0], contacts_in.worldid)):
            if contacts_in.efc_address[con, 0] < 0 and contact_bars_in.dist[con] == 0.0:
                continue
            worldid = contacts_in.worldid[con]
            geoms = contacts_in.geom[con]
            geom1 = geom_of(worldid, geoms[0], shapes, geom_xpos_in, geom_xmat_in)
            geom2 = geom_of(worldid, geoms[1], shapes, geom_xpos_in, geom_xmat_in)
            if is_convex_pair(geom1.type, geom2.type):
                continue
            contact = ContactPoint()
            contact.dist = contacts_in.dist[con]
            contact.point = contacts_in.pos[con]
            contact.normal = contacts_in.frame[con][0]
            guide = frame_guide(geom1, geom2, contacts_in.frame[con])
            normal_bar, guide_bar, _weight = wp.grad(frame_potential)(contact.normal, guide, contact_bars_in.frame[con])
            bars = Bars()
            bars.dist = contact_bars_in.dist[con]
            bars.point = contact_bars_in.pos[con]
            bars.normal = normal_bar

            index = contacts_in.geomcollisionid[con]
            push = PairPush()
            known = bool(False)
            if wp.static(kinds.has_potential):
                if has_potential(geom1.type, geom2.type):
                    known = bool(True)
                    push = push_by_potential(index, geom1, geom2, contact, bars)
            if wp.static(kinds.capsule_box):
                if geom1.type == GeomType.CAPSULE and geom2.type == GeomType.BOX:
                    known = bool(True)
                    push = capsule_box_push(index, geom1, geom2, contact, bars)
            if not known and geom1.type == GeomType.PLANE:
                push = plane_push(geom1, geom2, contact, bars, guide, guide_bar.axis)
                if wp.static(kinds.standing):
                    if geom2.type == GeomType.CYLINDER:
                        arm = push.place2 - geom2.pos
                        around, exact = rim_torque(contact.normal, column(geom2.mat, 2), arm, push.force2)
                        push.torque2 += around
                        push.torque1 -= around
                        if not exact and (bars.dist != 0.0 or wp.dot(bars.point, bars.point) != 0.0):
                            ngeom = shapes.geom_type.shape[0]
                            count_touch(
                                touches_out, worldid, substep, ngeom, geoms[0], geoms[1], geom1.type, geom2.type
                            )

            if contact_wrenches_out.shape[0] > 0:
                contact_wrenches_out[con, 0] = wrench(push.force1, push.torque1, push.place1 - geom1.pos)
                contact_wrenches_out[con, 1] = wrench(push.force2, push.torque2, push.place2 - geom2.pos)
            body1 = shapes.geom_bodyid[geoms[0]]
            body2 = shapes.geom_bodyid[geoms[1]]
            if body1 > 0:
                arm1 = push.place1 - subtree_com_in[worldid, shapes.body_rootid[body1]]
                wp.atomic_add(bars_out.moved, worldid, body1, wrench(push.force1, push.torque1, arm1))
            if body2 > 0:
                arm2 = push.place2 - subtree_com_in[worldid, shapes.body_rootid[body2]]
                wp.atomic_add(bars_out.moved, worldid, body2, wrench(push.force2, push.torque2, arm2))

    return pull_geometry
