"""The constraint problem of one world: min over a of ½ (a - a⁰)ᵀ M (a - a⁰) + Σ s(J a - aref), s being costs of rows.

Axes: W worlds, R rows, C contacts.
"""

import warp as wp

from msk_ray.physics import mjw_private as private
from msk_ray.physics.fused.blocks import below, block, factor_block, put_block
from msk_ray.physics.fused.cones import QUADRATIC, SATISFIED, update_contact
from msk_ray.physics.fused.memory import four, number, put_four, put_number, put_whole, whole
from msk_ray.physics.fused.scratch import Scratch
from msk_ray.physics.mjw_private import ConstraintType, vec5

wp.set_module_options({"enable_backward": False})

_ELLIPTIC = wp.constant(int(ConstraintType.CONTACT_ELLIPTIC))
_LINEARNEG = wp.constant(int(private.ConstraintState.LINEARNEG))
_LINEARPOS = wp.constant(int(private.ConstraintState.LINEARPOS))


@wp.struct
class RowsIn:
    """mujoco_warp's rows, (W, R), with what contacts add to them, (C,)."""

    type: wp.array2d[int]
    id: wp.array2d[int]
    D: wp.array2d[float]
    aref: wp.array2d[float]
    frictionloss: wp.array2d[float]
    jacobian: wp.array2d[wp.vec4]
    """J, (W, ...), row by row in blocks."""
    jacobian_blocks: int
    """Blocks of its rows, in which it has more room than the problem needs."""
    friction: wp.array[vec5]
    dim: wp.array[int]


@wp.struct
class World:
    """Sizes of one world's problem, of which its thread knows all."""

    id: int
    nv: int
    blocks: int
    """Blocks of 4 degrees of freedom."""
    room: int
    """R."""
    equalities: int
    frictions: int
    scalars: int
    """Rows that are no part of an elliptic contact; equalities come first, then frictions."""
    contacts: int
    """Elliptic ones."""
    contact_rows: int


@wp.func
def place(w: World, scalar: int) -> int:
    """Where a row is that is no part of an elliptic contact."""
    return w.room - 1 - scalar


@wp.func
def read_row(rows: RowsIn, scratch: Scratch, w: World, p: int) -> None:
    """Copy a row, of which source and bound are known."""
    source = whole(scratch.source, w.id, p)
    total = float(0.0)
    for k in range(w.blocks):
        part = four(rows.jacobian, w.id, source * rows.jacobian_blocks + k)
        left = w.nv - 4 * k
        # mujoco_warp promises nothing of what is behind nv.
        part = wp.vec4(
            part[0],
            wp.where(left > 1, part[1], 0.0),
            wp.where(left > 2, part[2], 0.0),
            wp.where(left > 3, part[3], 0.0),
        )
        put_four(scratch.rows, w.id, p * w.blocks + k, part)
        put_four(scratch.rows, w.id, (w.room + p) * w.blocks + k, part)
        total += wp.dot(part, four(scratch.acc, w.id, k))
    spring = four(scratch.springs, w.id, p)
    spring[0] = number(rows.D, w.id, source)
    spring[2] = total - number(rows.aref, w.id, source)
    put_four(scratch.springs, w.id, p, spring)
    put_number(scratch.weight, w.id, p, 0.0)
    put_whole(scratch.state, w.id, p, SATISFIED)


@wp.func
def place_row(scratch: Scratch, w: World, p: int, source: int, bound: float) -> None:
    put_whole(scratch.source, w.id, p, source)
    put_four(scratch.springs, w.id, p, wp.vec4(0.0, bound, 0.0, 0.0))


@wp.func
def read_rows(rows: RowsIn, scratch: Scratch, sizes: World, count: int, impratio: float) -> World:
    """Copy `count` rows to their places, and J a - aref. A contact of which rows are lost is left out."""
    w = sizes
    w.scalars = 0
    w.contacts = 0
    w.contact_rows = 0
    r = int(0)
    while r < count:
        if whole(rows.type, w.id, r) != _ELLIPTIC:
            place_row(scratch, w, place(w, w.scalars), r, number(rows.frictionloss, w.id, r))
            w.scalars += 1
            r += 1
        else:
            contact = whole(rows.id, w.id, r)
            dim = rows.dim[contact]
            if r + dim <= count:
                friction = rows.friction[contact]
                put_whole(scratch.first, w.id, w.contacts, w.contact_rows)
                place_row(scratch, w, w.contact_rows, r, friction[0] * impratio)
                for i in range(1, dim):
                    place_row(scratch, w, w.contact_rows + i, r + i, friction[i - 1])
                w.contacts += 1
                w.contact_rows += dim
            r += dim
    put_whole(scratch.first, w.id, w.contacts, w.contact_rows)
    for p in range(w.contact_rows):
        read_row(rows, scratch, w, p)
    for scalar in range(w.scalars):
        read_row(rows, scratch, w, place(w, scalar))
    return w


@wp.func
def update_rows(scratch: Scratch, w: World) -> bool:
    """Forces, states and weights of all rows at their J a - aref; whether the Hessian may have changed."""
    changed = bool(False)
    for scalar in range(w.scalars):
        p = place(w, scalar)
        row = four(scratch.springs, w.id, p)
        state = QUADRATIC
        force = -row[0] * row[2]
        if scalar >= w.equalities:
            if scalar < w.equalities + w.frictions:
                if force >= row[1]:
                    state = _LINEARNEG
                    force = row[1]
                elif force <= -row[1]:
                    state = _LINEARPOS
                    force = -row[1]
            elif row[2] >= 0.0:
                state = SATISFIED
                force = 0.0
        weight = wp.where(state == QUADRATIC, row[0], 0.0)
        changed = changed or weight != number(scratch.weight, w.id, p)
        put_number(scratch.force, w.id, p, force)
        put_number(scratch.weight, w.id, p, weight)
        put_whole(scratch.state, w.id, p, state)
    for contact in range(w.contacts):
        turned = update_contact(scratch, w.id, w.blocks, w.room, contact)
        changed = changed or turned
    return changed


@wp.func
def add_forces(scratch: Scratch, w: World, begin: int, end: int, k: int, start: wp.vec4) -> wp.vec4:
    """`start` and part k of Σ f J over some rows. Four at a time, so that their numbers are fetched together."""
    total = start
    for p in range(begin, end, 4):
        for i in range(4):
            row = wp.min(p + i, end - 1)
            force = wp.where(p + i < end, number(scratch.force, w.id, row), 0.0)
            total += force * four(scratch.rows, w.id, row * w.blocks + k)
    return total


@wp.func
def update_gradient(scratch: Scratch, w: World) -> float:
    """Jᵀ f and the gradient M a - τ - Jᵀ f; returns its square."""
    square = float(0.0)
    for k in range(w.blocks):
        push = add_forces(scratch, w, 0, w.contact_rows, k, wp.vec4(0.0))
        push = add_forces(scratch, w, w.room - w.scalars, w.room, k, push)
        slope = four(scratch.inertial, w.id, k) - four(scratch.smooth, w.id, k) - push
        put_four(scratch.push, w.id, k, push)
        put_four(scratch.gradient, w.id, k, slope)
        square += wp.dot(slope, slope)
    return square


@wp.func
def add_squares(
    scratch: Scratch, w: World, begin: int, end: int, behind: int, i: int, j: int, start: wp.mat44
) -> wp.mat44:
    """`start` and block (i, j) of Σ weight row rowᵀ over some rows, `behind` of which those to take are."""
    total = start
    for p in range(begin, end, 4):
        for k in range(4):
            row = wp.min(p + k, end - 1)
            weight = wp.where(p + k < end, number(scratch.weight, w.id, row), 0.0)
            at = (row + behind) * w.blocks
            total += wp.outer(weight * four(scratch.rows, w.id, at + i), four(scratch.rows, w.id, at + j))
    return total


@wp.func
def factor_hessian(scratch: Scratch, w: World) -> None:
    """The Cholesky factor of the Hessian, column of blocks by column, each of which is added up when it is due."""
    for j in range(w.blocks):
        pivot = wp.mat44(0.0)
        for i in range(j, w.blocks):
            total = block(scratch.inertia, w.id, i, j, w.blocks)
            total = add_squares(scratch, w, 0, w.contact_rows, w.room, i, j, total)
            total = add_squares(scratch, w, w.room - w.scalars, w.room, 0, i, j, total)
            for k in range(j):
                total -= block(scratch.factor, w.id, i, k, w.blocks) @ wp.transpose(
                    block(scratch.factor, w.id, j, k, w.blocks)
                )
            if i == j:
                pivot = factor_block(total)
                put_block(scratch.factor, w.id, j, j, w.blocks, pivot)
            else:
                put_block(scratch.factor, w.id, i, j, w.blocks, below(pivot, total))
