"""Where a face clips the side of a capsule: the line along the side that MuJoCo clips, and how it moves.

MuJoCo first finds one contact, of normal m, from the other geom to the capsule. If a face next to the feature that the
capsule touches is nearly parallel to its axis, it clips the line along the axis through the point found, at -r P m from
the axis (P: projector across it). If that face is the feature, m is its normal; else m obeys the law of the two patches
that touched first.
"""

import warp as wp
from mujoco_warp import GeomType

from msk_ray.step.adjoint.groups import Meshes
from msk_ray.step.adjoint.laws.contact_geometry.contact_point import Bars, ContactPoint
from msk_ray.step.adjoint.laws.contact_geometry.convex_laws import Push, touching_wrenches
from msk_ray.step.adjoint.laws.contact_geometry.patches import EDGE, Patch, rim_bend, tangential
from msk_ray.step.adjoint.laws.contact_geometry.solids import Solid, farthest, tied_corner
from msk_ray.step.adjoint.spatial import column

wp.set_module_options({"enable_backward": False})

_ON_SIDE = wp.constant(1.0e-4)
"""How far the line may be from a radius off the axis, in radii, if the capsule touched with its side."""
_APART = wp.constant(1.0e-3)
"""How far, in sizes, the features may miss each other along m."""


@wp.func
def side_offset(capsule: Solid, place: wp.vec3) -> wp.vec3:
    """The offset of a point from a capsule's axis, in radii."""
    axis = column(capsule.mat, 2)
    arm = place - capsule.pos
    return (arm - axis * wp.dot(axis, arm)) / capsule.size[0]


@wp.func
def first_normal(capsule: Solid, offset: wp.vec3, plane: wp.vec3) -> wp.vec3:
    """m of the contact found first, from the line's offset and the normal of the face that clips it."""
    axis = column(capsule.mat, 2)
    rest = wp.max(0.0, 1.0 - wp.dot(offset, offset))
    if rest < 2.0 * _ON_SIDE:
        rest = float(0.0)
    return -wp.normalize(offset - axis * (wp.sqrt(rest) * wp.sign(wp.dot(axis, plane))))


@wp.func
def line_wrenches(
    below: Solid,
    capsule: Solid,
    meshes: Meshes,
    normal: wp.vec3,
    contact: ContactPoint,
    gap_bar: wp.vec3,
    length: float,
) -> tuple[Push, wp.bool]:
    """What the line's motion adds to the pullback of a clipped point, and whether the law of m is known.

    Args:
        below: the geom with the face.
        capsule: the other one.
        meshes: hulls of meshes.
        normal: m.
        contact: as mujoco_warp returned it.
        gap_bar: cotangent of the foot's motion relative to the ground.
        length: unit of length.
    """
    axis = column(capsule.mat, 2)
    radius = capsule.size[0]
    # v ∋ -r P m  ⇒  cotangent of m's turn relative to the capsule
    turn_bar = -radius * (tangential(axis) @ gap_bar)
    patch1 = Patch()
    patch2 = Patch()
    patch2.bend = radius * tangential(normal)
    corner = farthest(below, meshes, normal)
    on_side = wp.abs(wp.dot(axis, normal)) < _ON_SIDE
    up = wp.where(wp.dot(axis, normal) < 0.0, 1.0, -1.0)
    core = capsule.pos + up * capsule.size[1] * axis
    flat_axis = wp.vec3(0.0)
    if on_side:
        patch2.kind = EDGE
        patch2.run = axis
        flat_axis = wp.normalize(tangential(normal) @ axis)
        core = capsule.pos + wp.dot(flat_axis, corner - capsule.pos) * flat_axis
    from_corner = tangential(normal) @ (corner - core)
    # At a corner the capsule is straight above it, on an edge m is across the edge: the nearer of both.
    tied, other = tied_corner(below, meshes, normal, corner)
    run = wp.normalize(other - corner)
    tied = tied and radius * wp.abs(wp.dot(run, normal)) < wp.length(from_corner)
    if tied:
        patch1.kind = EDGE
        patch1.run = run
        if on_side:
            # Where the two lines cross, seen along m.
            b = wp.dot(flat_axis, run)
            core += (b * wp.dot(run, from_corner) / wp.min(b * b - 1.0, -1.0e-9)) * flat_axis
            from_corner = tangential(normal) @ (corner - core)
    if below.type == GeomType.CYLINDER:
        patch1.bend = rim_bend(below.size[0], column(below.mat, 2), normal)
    at = corner
    if tied:
        at = corner - wp.dot(run, from_corner) * run
    surface = core - radius * normal
    first = ContactPoint()
    first.normal = normal
    first.dist = wp.dot(normal, surface - at)
    first.point = 0.5 * (surface + at)
    apart = wp.length(tangential(normal) @ (surface - at))
    bars = Bars()
    bars.normal = turn_bar
    push, regular = touching_wrenches(patch1, patch2, first, bars, length)
    arm = first.point - contact.point
    push.torque1 += wp.cross(arm, push.force1)
    push.torque2 += wp.cross(arm, push.force2)
    # δm relative to the capsule: δm - ω₂×m
    push.torque2 -= wp.cross(normal, turn_bar)
    return push, regular and apart < _APART * length
