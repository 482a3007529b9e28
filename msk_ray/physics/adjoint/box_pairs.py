"""Cotangents of a contact of boxes, or of a capsule and a box, to the poses of both geometries."""

import warp as wp

from msk_ray.physics.adjoint.box_laws import EdgeLaw, FaceLaw, capsule_score, edge_score, face_score, point_score
from msk_ray.physics.adjoint.box_search import (
    BY_EDGES,
    BY_FACE,
    BY_POINTS,
    axis_law,
    box_laws,
    capsule_seen_at,
)
from msk_ray.physics.adjoint.spatial import turning_torque

wp.set_module_options({"enable_backward": False})


@wp.func
def capsule_box_wrenches(
    index: int,
    pos: wp.vec3,
    mat: wp.mat33,
    size: wp.vec3,
    box_pos: wp.vec3,
    box_mat: wp.mat33,
    box_size: wp.vec3,
    dist: float,
    point: wp.vec3,
    normal: wp.vec3,
    dist_bar: float,
    pos_bar: wp.vec3,
    normal_bar: wp.vec3,
) -> tuple[wp.vec3, wp.vec3, wp.vec3, wp.vec3]:
    """Forces at the centres of capsule and box and torques on them: (force1, torque1, force2, torque2)."""
    axis = wp.vec3(mat[0, 2], mat[1, 2], mat[2, 2])
    seen = capsule_seen_at(pos, axis, size[0], dist, point, normal)
    law = axis_law(index, seen, pos, axis, size[1], box_pos, box_mat, box_size)
    pos1_bar, axis_bar, _r, pos2_bar, mat2_bar, _s, _l, _d, _p, _n = wp.grad(capsule_score)(
        pos, axis, size[0], box_pos, box_mat, box_size, law, dist_bar, pos_bar, normal_bar
    )
    return pos1_bar, wp.cross(axis, axis_bar), pos2_bar, turning_torque(box_mat, mat2_bar)


@wp.func
def face_wrenches(
    owner: int,
    pos1: wp.vec3,
    mat1: wp.mat33,
    pos2: wp.vec3,
    mat2: wp.mat33,
    law: FaceLaw,
    dist_bar: float,
    pos_bar: wp.vec3,
    normal_bar: wp.vec3,
) -> tuple[wp.vec3, wp.vec3, wp.vec3, wp.vec3]:
    """Those of a face law, whose reference is box 1 or box 2."""
    if owner == 2:
        pos2_bar, mat2_bar, pos1_bar, mat1_bar, _l, _d, _p, _n = wp.grad(face_score)(
            pos2, mat2, pos1, mat1, law, dist_bar, pos_bar, -normal_bar
        )
        return pos1_bar, turning_torque(mat1, mat1_bar), pos2_bar, turning_torque(mat2, mat2_bar)
    pos1_bar, mat1_bar, pos2_bar, mat2_bar, _l, _d, _p, _n = wp.grad(face_score)(
        pos1, mat1, pos2, mat2, law, dist_bar, pos_bar, normal_bar
    )
    return pos1_bar, turning_torque(mat1, mat1_bar), pos2_bar, turning_torque(mat2, mat2_bar)


@wp.func
def edge_wrenches(
    pos1: wp.vec3,
    mat1: wp.mat33,
    pos2: wp.vec3,
    mat2: wp.mat33,
    law: EdgeLaw,
    dist_bar: float,
    pos_bar: wp.vec3,
    normal_bar: wp.vec3,
) -> tuple[wp.vec3, wp.vec3, wp.vec3, wp.vec3]:
    """Those of an edge law."""
    pos1_bar, mat1_bar, pos2_bar, mat2_bar, _l, _d, _p, _n = wp.grad(edge_score)(
        pos1, mat1, pos2, mat2, law, dist_bar, pos_bar, normal_bar
    )
    return pos1_bar, turning_torque(mat1, mat1_bar), pos2_bar, turning_torque(mat2, mat2_bar)


@wp.func
def box_box_wrenches(
    native_ccd: int,
    pos1: wp.vec3,
    mat1: wp.mat33,
    size1: wp.vec3,
    pos2: wp.vec3,
    mat2: wp.mat33,
    size2: wp.vec3,
    dist: float,
    point: wp.vec3,
    normal: wp.vec3,
    dist_bar: float,
    pos_bar: wp.vec3,
    normal_bar: wp.vec3,
) -> tuple[wp.vec3, wp.vec3, wp.vec3, wp.vec3]:
    """Forces at the centres of two boxes and torques on them: (force1, torque1, force2, torque2)."""
    kind, owner, face, edge, points, dist_kind, dist_owner, dist_face, dist_edge = box_laws(
        pos1, mat1, size1, pos2, mat2, size2, dist, point, normal, native_ccd
    )
    zero = wp.vec3(0.0)
    force1 = zero
    torque1 = zero
    force2 = zero
    torque2 = zero
    weight = wp.where(dist_kind == 0, dist_bar, 0.0)
    if kind == BY_FACE:
        force1, torque1, force2, torque2 = face_wrenches(
            owner, pos1, mat1, pos2, mat2, face, weight, pos_bar, normal_bar
        )
    if kind == BY_EDGES:
        force1, torque1, force2, torque2 = edge_wrenches(pos1, mat1, pos2, mat2, edge, weight, pos_bar, normal_bar)
    if kind == BY_POINTS:
        pos1_bar, mat1_bar, pos2_bar, mat2_bar, _l, _d, _p, _n = wp.grad(point_score)(
            pos1, mat1, pos2, mat2, points, weight, pos_bar, normal_bar
        )
        force1 = pos1_bar
        torque1 = turning_torque(mat1, mat1_bar)
        force2 = pos2_bar
        torque2 = turning_torque(mat2, mat2_bar)
    if dist_kind != 0:
        f1 = zero
        t1 = zero
        f2 = zero
        t2 = zero
        if dist_kind == BY_FACE:
            f1, t1, f2, t2 = face_wrenches(dist_owner, pos1, mat1, pos2, mat2, dist_face, dist_bar, zero, zero)
        if dist_kind == BY_EDGES:
            f1, t1, f2, t2 = edge_wrenches(pos1, mat1, pos2, mat2, dist_edge, dist_bar, zero, zero)
        force1 += f1
        torque1 += t1
        force2 += f2
        torque2 += t2
    return force1, torque1, force2, torque2
