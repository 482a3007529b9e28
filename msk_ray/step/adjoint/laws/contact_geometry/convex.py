"""Contacts that MuJoCo finds by its convex collision: from the witness points to wrenches on the two bodies.

The features that touch are found again from the contact, and the law they obey is pulled back (`convex_laws`). The
patch of each geom (`patches`) is a FACE, also a cylinder's cap; an EDGE, also the side of a cylinder or a capsule; or a
POINT: a corner, a rim, a capsule's end, anything else that is curved. A height field counts as its faces near the
contact. Of these rows, the first that fits:

| first geom | second geom | patch that wins | law |
|---|---|---|---|
| a face on which the second's lies, in a pair that is clipped | FACE that gives the normal | the first's | standing |
| FACE | EDGE, POINT, or FACE that is no nearer to the normal | the first's | standing |
| any | FACE | the second's | standing, with the geoms exchanged |
| EDGE or POINT | EDGE or POINT | both | touching |

Standing (`standing_wrenches`): a point of the other geom (`support_points`) above the face, by `flat_wrenches`; with
`height_wrenches` where clipping kept an earlier distance, and `line_wrenches` where it cut a capsule's side. Touching:
`touching_wrenches`. MuJoCo clips two boxes, and with several contacts per pair any two geoms with faces, or one and a
capsule.

A contact that no law reproduces, or that has no derivative, as of two parallel edges, is counted.
"""

import warp as wp
from mujoco_warp import GeomType

from msk_ray.step.adjoint.coverage.approximated import Touches, count_touch
from msk_ray.step.adjoint.groups import ContactBars, Contacts, FieldBars, Meshes, Shapes
from msk_ray.step.adjoint.laws.contact_geometry.contact_order import contacts_end
from msk_ray.step.adjoint.laws.contact_geometry.contact_point import Bars, ContactPoint
from msk_ray.step.adjoint.laws.contact_geometry.convex_laws import (
    Push,
    added,
    flat_wrenches,
    height_wrenches,
    swapped,
    touching_wrenches,
)
from msk_ray.step.adjoint.laws.contact_geometry.patches import EDGE, FACE, Patch, patch_at
from msk_ray.step.adjoint.laws.contact_geometry.primitive_laws import is_convex_pair
from msk_ray.step.adjoint.laws.contact_geometry.side_lines import first_normal, line_wrenches, side_offset
from msk_ray.step.adjoint.laws.contact_geometry.solids import (
    Solid,
    face_along,
    face_corner,
    face_count,
    face_normal,
    farthest,
    has_corners,
    looked_at,
    off_face,
    out_of,
)
from msk_ray.step.adjoint.laws.contact_geometry.support_points import foot_of, ground_of, unit_of_length
from msk_ray.step.adjoint.spatial import column, wrench
from msk_ray.step.forward.mjw_private import make_frame

wp.set_module_options({"enable_backward": False})

_LYING = wp.constant(0.99605)
"""Cosine above which MuJoCo's convex collision takes two faces as lying on each other: its own FACE_TOL, cos 0.0889."""
_SLACK = wp.constant(1.0e-3)
"""Sine of the angle by which a normal may miss that of the face that gave it: what is left in deep contacts, where
rounding of the witness points turns it by far less."""
_MOST_SLACK = wp.constant(5.0e-2)
"""The same for shallow contacts and curved surfaces; less than the 0.0889 within which MuJoCo takes faces as lying."""
_WITNESS_ROUNDING = wp.constant(1.0e-7)
"""Rounding of witness points, in sizes, that of float32; the normal is the direction between them."""
_KEPT = wp.constant(2.0e-5)
"""How much nearer, in sizes, a distance from before clipping must come: a hundred roundings of a place (`patches`)."""
_TOUCHED = wp.constant(1.0e-3)
"""Distance from a face, in sizes, within which a contact may be its: wide, because the law's miss decides."""
_UPWARD = wp.constant(1.0e-5)
"""Sine of the angle below which a contact's normal is a height field's axis: only rounding parts the two."""
_LOST = wp.constant(1.0e-4)
"""How far, in sizes, the law that comes nearest may miss a contact before the contact counts as approximated: five
times the difference that decides between two candidates."""


@wp.func
def clipping_face(below: Solid, above: Solid, other_face: int, meshes: Meshes, contact: ContactPoint) -> int:
    """The face of the geom below against which one of the geom above was clipped, -1 for none.

    Where the contact is on the side of a face, or over its corner, it is on others too; the law tells which it was.
    """
    best = int(-1)
    least = float(1.0e30)
    length = unit_of_length(below, above)
    at = contact.point - 0.5 * contact.dist * contact.normal
    local = wp.transpose(below.mat) @ (above.mat @ face_normal(above, meshes, other_face))
    for face in range(face_count(below, meshes)):
        if wp.dot(face_normal(below, meshes, face), local) < -_LYING:
            off = off_face(below, meshes, face, at)
            if off < _TOUCHED * length:
                ground = ground_of(below, meshes, face, length)
                _foot, miss = foot_of(above, other_face, ground, meshes, contact, True)
                if miss + off < least:
                    least = miss + off
                    best = face
    return best


@wp.func
def side_by_side(solid1: Solid, solid2: Solid, normal: wp.vec3) -> bool:
    """Whether two capsules or cylinders touch along parallel sides: convex collision then finds any point of them."""
    long1 = solid1.type == GeomType.CAPSULE or solid1.type == GeomType.CYLINDER
    long2 = solid2.type == GeomType.CAPSULE or solid2.type == GeomType.CYLINDER
    axis1 = column(solid1.mat, 2)
    axis2 = column(solid2.mat, 2)
    across = wp.abs(wp.dot(axis1, normal)) < _SLACK and wp.abs(wp.dot(axis2, normal)) < _SLACK
    return long1 and long2 and across and wp.length(wp.cross(axis1, axis2)) < _SLACK


@wp.func
def cap_lies_flat(solid: Solid, normal: wp.vec3) -> bool:
    """Whether a cylinder's cap lies on a face: convex collision clips polygons then, whose corners on the round rim
    jump with the smallest tilt."""
    return solid.type == GeomType.CYLINDER and wp.abs(wp.dot(column(solid.mat, 2), normal)) > _LYING


@wp.func
def is_supported(solid: Solid, patch: Patch, normal: wp.vec3, slack: float) -> bool:
    """Whether the surface around a contact has its normal: convex collision may stop before it finds the way out."""
    supported = bool(True)
    if has_corners(solid) and patch.kind == EDGE:
        supported = wp.abs(wp.dot(patch.run, normal)) < slack
    return supported


@wp.func
def standing_wrenches(
    below: Solid,
    above: Solid,
    meshes: Meshes,
    face: int,
    other_face: int,
    turns_with_other: int,
    contact: ContactPoint,
    bars: Bars,
    is_clipped: bool,
) -> tuple[Push, wp.float32]:
    """Pullback of a contact of the geom above with a face of the geom below, and how far the law misses it [sizes].

    Both `contact` and `bars` have the normal away from the geom below.
    """
    length = unit_of_length(below, above)
    ground = ground_of(below, meshes, face, length)
    at = contact
    if turns_with_other == 0:
        at.normal = ground.normal
    foot, miss = foot_of(above, other_face, ground, meshes, at, is_clipped)
    # Clipping that leaves one point keeps the distance found before.
    height = wp.dot(ground.normal, foot.place - ground.origin)
    error = wp.abs(height * wp.dot(ground.normal, at.normal) - at.dist)
    aside = miss - error
    rest = bars
    kept = Push()
    if is_clipped and error > _KEPT * length:
        deepest = farthest(above, meshes, -ground.normal)
        other_error = wp.abs(wp.dot(ground.normal, deepest - ground.origin) - at.dist)
        if other_error < error - _KEPT * length:
            error = other_error
            kept = height_wrenches(deepest, ground.normal, at, bars.dist)
            rest.dist = 0.0
        if other_face >= 0:
            facing = above.mat @ face_normal(above, meshes, other_face)
            through = out_of(above, face_corner(above, meshes, other_face, 0))
            deepest = farthest(below, meshes, -facing)
            other_error = wp.abs(wp.dot(facing, deepest - through) - at.dist)
            if other_error < error - _KEPT * length:
                error = other_error
                kept = swapped(height_wrenches(deepest, facing, at, bars.dist))
                rest.dist = 0.0
    push = flat_wrenches(foot, ground.normal, at, rest, turns_with_other)
    if foot.line == 1:
        normal = first_normal(above, side_offset(above, foot.place), ground.normal)
        line, known = line_wrenches(below, above, meshes, normal, at, push.force2, length)
        push = added(push, line)
        if not known:
            aside = length
    push = added(push, kept)
    return push, wp.where(miss > 0.0, (aside + error) / length, 0.0)


@wp.func
def convex_wrenches(
    first: Solid, solid2: Solid, meshes: Meshes, contact: ContactPoint, bars: Bars, native_ccd: int, multi_ccd: int
) -> tuple[Push, wp.bool]:
    """Forces and torques of one contact, and whether they are exact.

    Args:
        first: the first geom, a height field or convex.
        solid2: the second, convex.
        meshes: hulls of meshes.
        contact: as mujoco_warp returned it.
        bars: its cotangents.
        native_ccd: 1 if boxes collide by convex collision too, 0 if by their own.
        multi_ccd: 1 if convex collision clips faces to find several contacts.
    """
    n = contact.normal
    solid1 = first
    field = first.type == GeomType.HFIELD
    if field:
        solid1 = looked_at(first, meshes, contact.point - 0.5 * contact.dist * n)
    length = unit_of_length(solid1, solid2)
    slack = wp.min(_SLACK + _WITNESS_ROUNDING * length / wp.max(wp.abs(contact.dist), 1.0e-9), _MOST_SLACK)
    face1, sine1 = face_along(solid1, meshes, n)
    face2, sine2 = face_along(solid2, meshes, -n)
    boxes = solid1.type == GeomType.BOX and solid2.type == GeomType.BOX
    own_boxes = boxes and native_ccd == 0
    faced1 = (has_corners(solid1) and not field) or solid1.type == GeomType.CYLINDER
    faced2 = has_corners(solid2) or solid2.type == GeomType.CYLINDER
    long1 = solid1.type == GeomType.CAPSULE
    long2 = solid2.type == GeomType.CAPSULE
    is_clipped = boxes or (multi_ccd == 1 and ((faced1 and (faced2 or long2)) or (long1 and faced2)))

    flipped = contact
    flipped.normal = -n
    flipped_bars = bars
    flipped_bars.normal = -bars.normal
    push = Push()
    # From within a prism of a height field the way out may lead sideways; MuJoCo then pushes along the field's axis.
    flat = has_corners(solid1) and has_corners(solid2)
    exact = not (field and sine1 > slack and wp.length(wp.cross(n, column(solid1.mat, 2))) < _UPWARD)
    miss = float(0.0)
    below = int(-1)
    if is_clipped and not own_boxes and face2 >= 0 and sine2 < slack:
        below = clipping_face(solid1, solid2, face2, meshes, contact)
    if below >= 0:
        # The second geom's face is clipped against the first's, and gives the normal.
        push, miss = standing_wrenches(solid1, solid2, meshes, below, face2, 1, contact, bars, is_clipped)
    else:
        # Flat faces, and edges along them, have been clipped; whether a capsule has been tells where it lies.
        clipped = is_clipped and not (long1 or long2)
        level1 = wp.where(clipped or solid1.type == GeomType.CYLINDER, slack, 0.0)
        level2 = wp.where(clipped or solid2.type == GeomType.CYLINDER, slack, 0.0)
        place1 = contact.point - 0.5 * contact.dist * n
        place2 = contact.point + 0.5 * contact.dist * n
        patch1 = patch_at(solid1, solid2, meshes, place1, n, contact.dist, face1, sine1, level1)
        patch2 = patch_at(solid2, solid1, meshes, place2, -n, contact.dist, face2, sine2, level2)
        # Boxes of their own collision are clipped at any angle.
        clip1 = wp.where(own_boxes, face1, -1)
        clip2 = wp.where(own_boxes, face2, -1)
        if patch1.kind == FACE and (patch2.kind != FACE or sine1 <= sine2 + _SLACK):
            push, miss = standing_wrenches(solid1, solid2, meshes, patch1.face, clip2, 0, contact, bars, is_clipped)
            exact = exact and not (flat and sine1 > slack)
        elif patch2.kind == FACE:
            push, miss = standing_wrenches(
                solid2, solid1, meshes, patch2.face, clip1, 0, flipped, flipped_bars, is_clipped
            )
            push = swapped(push)
            exact = exact and not (flat and sine2 > slack)
        else:
            # Edges of flat faces meet exactly; curved surfaces only as MuJoCo's tolerance says.
            tilt = wp.where(flat, slack, _MOST_SLACK)
            exact = exact and is_supported(solid1, patch1, n, tilt) and is_supported(solid2, patch2, n, tilt)
            push, regular = touching_wrenches(patch1, patch2, contact, bars, length)
            exact = exact and regular and not side_by_side(solid1, solid2, n)
    jumps = is_clipped and faced1 and faced2 and (cap_lies_flat(solid1, n) or cap_lies_flat(solid2, n))
    return push, exact and miss < _LOST and not jumps


@wp.func
def solid_of(
    geomid: int, worldid: int, shapes: Shapes, meshes: Meshes, xpos: wp.array2d[wp.vec3], xmat: wp.array2d[wp.mat33]
) -> Solid:
    """A geom of one world."""
    solid = Solid()
    solid.type = shapes.geom_type[geomid]
    solid.pos = xpos[worldid, geomid]
    solid.mat = xmat[worldid, geomid]
    solid.size = shapes.geom_size[worldid % shapes.geom_size.shape[0], geomid]
    solid.mesh = meshes.geom_dataid[worldid % meshes.geom_dataid.shape[0], geomid]
    return solid


@wp.func
def framed(normal: wp.vec3, weight: wp.mat33) -> wp.float32:
    """⟨weight, frame⟩ of the contact frame that mujoco_warp builds from a normal."""
    frame = make_frame(normal)
    return wp.dot(weight[0], frame[0]) + wp.dot(weight[1], frame[1]) + wp.dot(weight[2], frame[2])


@wp.kernel
def pull_convex(
    in_turn: bool,
    # Model:
    shapes: Shapes,
    meshes: Meshes,
    native_ccd: int,
    multi_ccd: int,
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
        geoms = contacts_in.geom[con]
        type1 = shapes.geom_type[geoms[0]]
        type2 = shapes.geom_type[geoms[1]]
        if not is_convex_pair(type1, type2):
            continue
        bars = Bars()
        bars.dist = contact_bars_in.dist[con]
        bars.point = contact_bars_in.pos[con]
        if contact_wrenches_out.shape[0] > 0:
            contact_wrenches_out[con, 0] = wp.spatial_vector(wp.vec3(0.0), wp.vec3(0.0))
            contact_wrenches_out[con, 1] = wp.spatial_vector(wp.vec3(0.0), wp.vec3(0.0))
        # A contact that pushes nothing, or whose world has no cotangent, has none either.
        if bars.dist == 0.0 and wp.dot(bars.point, bars.point) == 0.0:
            continue
        contact = ContactPoint()
        contact.dist = contacts_in.dist[con]
        contact.point = contacts_in.pos[con]
        contact.normal = contacts_in.frame[con][0]
        normal_bar, _weight = wp.grad(framed)(contact.normal, contact_bars_in.frame[con])
        bars.normal = normal_bar
        worldid = contacts_in.worldid[con]
        solid1 = solid_of(geoms[0], worldid, shapes, meshes, geom_xpos_in, geom_xmat_in)
        solid2 = solid_of(geoms[1], worldid, shapes, meshes, geom_xpos_in, geom_xmat_in)
        push, exact = convex_wrenches(solid1, solid2, meshes, contact, bars, native_ccd, multi_ccd)
        if not exact:
            count_touch(touches_out, worldid, substep, shapes.geom_type.shape[0], geoms[0], geoms[1], type1, type2)
        if contact_wrenches_out.shape[0] > 0:
            contact_wrenches_out[con, 0] = wrench(push.force1, push.torque1, contact.point - solid1.pos)
            contact_wrenches_out[con, 1] = wrench(push.force2, push.torque2, contact.point - solid2.pos)
        body1 = shapes.geom_bodyid[geoms[0]]
        body2 = shapes.geom_bodyid[geoms[1]]
        if body1 > 0:
            arm = contact.point - subtree_com_in[worldid, shapes.body_rootid[body1]]
            wp.atomic_add(bars_out.moved, worldid, body1, wrench(push.force1, push.torque1, arm))
        if body2 > 0:
            arm = contact.point - subtree_com_in[worldid, shapes.body_rootid[body2]]
            wp.atomic_add(bars_out.moved, worldid, body2, wrench(push.force2, push.torque2, arm))
