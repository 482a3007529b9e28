"""The constraint problem of one world: min over a of ½ (a - a⁰)ᵀ M (a - a⁰) + Σ s(J a - aref), s being costs of rows.

Axes: W worlds, R rows, C contacts.
"""

import warp as wp

from msk_ray.physics import mjw_private as private
from msk_ray.physics.fused.blocks import below, block, factor_block, four, put_block, put_four, row_product
from msk_ray.physics.fused.cones import QUADRATIC, SATISFIED, update_contact
from msk_ray.physics.fused.scratch import Scratch
from msk_ray.physics.mjw_private import ConstraintType, vec5

wp.set_module_options({"enable_backward": False})

_ELLIPTIC = wp.constant(int(ConstraintType.CONTACT_ELLIPTIC))
_LINEARNEG = wp.constant(int(private.ConstraintState.LINEARNEG))
_LINEARPOS = wp.constant(int(private.ConstraintState.LINEARPOS))


@wp.struct
class RowsIn:
    """mujoco_warp's rows, (W, R), and their Jacobian, (W, R, nv), with what contacts add to them, (C,)."""

    type: wp.array2d[int]
    id: wp.array2d[int]
    D: wp.array2d[float]
    aref: wp.array2d[float]
    frictionloss: wp.array2d[float]
    J: wp.array3d[float]
    friction: wp.array[vec5]
    dim: wp.array[int]


@wp.struct
class World:
    """Sizes of one world's problem, of which its thread knows all."""

    id: int
    nv: int
    width: int
    """nv in whole blocks."""
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
    source = scratch.source[w.id, p]
    for i in range(w.nv):
        scratch.rows[w.id, p * w.width + i] = rows.J[w.id, source, i]
    scratch.stiffness[w.id, p] = rows.D[w.id, source]
    scratch.weight[w.id, p] = 0.0
    scratch.state[w.id, p] = SATISFIED
    scratch.jar[w.id, p] = row_product(scratch.rows, w.id, p * w.width, scratch.acc, w.width) - rows.aref[w.id, source]


@wp.func
def read_rows(rows: RowsIn, scratch: Scratch, sizes: World, count: int, impratio: float) -> World:
    """Copy `count` rows to their places, and J a - aref. A contact of which rows are lost is left out."""
    w = sizes
    w.scalars = 0
    w.contacts = 0
    w.contact_rows = 0
    r = int(0)
    while r < count:
        if rows.type[w.id, r] != _ELLIPTIC:
            p = place(w, w.scalars)
            scratch.source[w.id, p] = r
            scratch.bound[w.id, p] = rows.frictionloss[w.id, r]
            w.scalars += 1
            r += 1
        else:
            contact = rows.id[w.id, r]
            dim = rows.dim[contact]
            if r + dim <= count:
                friction = rows.friction[contact]
                scratch.first[w.id, w.contacts] = w.contact_rows
                for i in range(dim):
                    p = w.contact_rows + i
                    scratch.source[w.id, p] = r + i
                    if i == 0:
                        scratch.bound[w.id, p] = friction[0] * impratio
                    else:
                        scratch.bound[w.id, p] = friction[i - 1]
                w.contacts += 1
                w.contact_rows += dim
            r += dim
    scratch.first[w.id, w.contacts] = w.contact_rows
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
        jar = scratch.jar[w.id, p]
        stiffness = scratch.stiffness[w.id, p]
        state = QUADRATIC
        force = -stiffness * jar
        if scalar >= w.equalities:
            if scalar < w.equalities + w.frictions:
                loss = scratch.bound[w.id, p]
                if stiffness * jar <= -loss:
                    state = _LINEARNEG
                    force = loss
                elif stiffness * jar >= loss:
                    state = _LINEARPOS
                    force = -loss
            elif jar >= 0.0:
                state = SATISFIED
                force = 0.0
        weight = wp.where(state == QUADRATIC, stiffness, 0.0)
        changed = changed or weight != scratch.weight[w.id, p]
        scratch.force[w.id, p] = force
        scratch.state[w.id, p] = state
        scratch.weight[w.id, p] = weight
    for contact in range(w.contacts):
        turned = update_contact(scratch, w.id, w.width, w.room, contact)
        changed = changed or turned
    return changed


@wp.func
def update_gradient(scratch: Scratch, w: World) -> float:
    """Jᵀ f and the gradient M a - τ - Jᵀ f; returns its square."""
    square = float(0.0)
    for k in range(0, w.width, 4):
        push = wp.vec4(0.0)
        for p in range(w.contact_rows):
            force = scratch.force[w.id, p]
            if force != 0.0:
                push += force * four(scratch.rows, w.id, p * w.width + k)
        for scalar in range(w.scalars):
            p = place(w, scalar)
            force = scratch.force[w.id, p]
            if force != 0.0:
                push += force * four(scratch.rows, w.id, p * w.width + k)
        slope = four(scratch.inertial, w.id, k) - four(scratch.smooth, w.id, k) - push
        put_four(scratch.push, w.id, k, push)
        put_four(scratch.gradient, w.id, k, slope)
        square += wp.dot(slope, slope)
    return square


@wp.func
def hessian_block(scratch: Scratch, w: World, i: int, j: int) -> wp.mat44:
    """The block at row i and column j of M plus the weighted squares of the rows."""
    total = block(scratch.inertia, w.id, i * w.width + j, w.width)
    for p in range(w.contact_rows):
        weight = scratch.weight[w.id, p]
        if weight != 0.0:
            row = p * w.width
            if scratch.state[w.id, p] != QUADRATIC:
                row += w.room * w.width
            total += wp.outer(weight * four(scratch.rows, w.id, row + i), four(scratch.rows, w.id, row + j))
    for scalar in range(w.scalars):
        p = place(w, scalar)
        weight = scratch.weight[w.id, p]
        if weight != 0.0:
            row = p * w.width
            total += wp.outer(weight * four(scratch.rows, w.id, row + i), four(scratch.rows, w.id, row + j))
    return total


@wp.func
def factor_hessian(scratch: Scratch, w: World) -> None:
    """The Cholesky factor of the Hessian, column of blocks by column, each of which is added up when it is due."""
    for j in range(0, w.width, 4):
        pivot = wp.mat44(0.0)
        for i in range(j, w.width, 4):
            total = hessian_block(scratch, w, i, j)
            for k in range(0, j, 4):
                total -= block(scratch.factor, w.id, i * w.width + k, w.width) @ wp.transpose(
                    block(scratch.factor, w.id, j * w.width + k, w.width)
                )
            if i == j:
                pivot = factor_block(total)
                put_block(scratch.factor, w.id, j * w.width + j, w.width, pivot)
            else:
                put_block(scratch.factor, w.id, i * w.width + j, w.width, below(pivot, total))
