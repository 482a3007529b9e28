"""The constraint problem of one world: min over a of ½ (a - a⁰)ᵀ M (a - a⁰) + Σ s(J a - aref), with s the rows' costs.

Axes: W worlds, R rows, C contacts.
"""

import math

import warp as wp

from msk_ray.step.forward import mjw_private as private
from msk_ray.step.forward.fused.cones import QUADRATIC, SATISFIED, lean_rows, update_contact
from msk_ray.step.forward.fused.dense import add_squares, combine, factorize
from msk_ray.step.forward.fused.lanes import at, four, lane_count, lane_sum, lane_sync, put, put_whole, whole
from msk_ray.step.forward.fused.scratch import Scratch
from msk_ray.step.forward.mjw_private import ConstraintType, vec5

wp.set_module_options({"enable_backward": False})

_ELLIPTIC = wp.constant(int(ConstraintType.CONTACT_ELLIPTIC))
_LINEARNEG = wp.constant(int(private.ConstraintState.LINEARNEG))
_LINEARPOS = wp.constant(int(private.ConstraintState.LINEARPOS))
_NAN = wp.constant(math.nan)


@wp.struct
class Rows:
    """mujoco_warp's constraint rows, (W, R), with their contacts' data, (C,)."""

    type: wp.array2d[int]
    id: wp.array2d[int]
    D: wp.array2d[float]
    aref: wp.array2d[float]
    frictionloss: wp.array2d[float]
    jacobian: wp.array2d[float]
    """J, (W, ...), row-major."""
    stride: int
    """Length of its rows, a multiple of four, nv or more."""
    squared: wp.array2d[float]
    """The rows whose weighted squares add to the Hessian: J itself, or with elliptic cones a copy in which the rows of
    sliding contacts are replaced."""
    force: wp.array2d[float]
    """Written."""
    state: wp.array2d[int]
    """Written."""
    friction: wp.array[vec5]
    dim: wp.array[int]


@wp.struct
class World:
    """Sizes of one world's problem, the same in all its lanes."""

    id: int
    lane: int
    nv: int
    width: int
    """nv rounded up to a multiple of four."""
    rows: int
    equalities: int
    frictions: int
    contacts: int
    """Number of elliptic contacts."""


@wp.func
def find_contacts(rows: Rows, scratch: Scratch, w: World, begin: int, impratio: float) -> int:
    """Number of elliptic contacts among the rows from `begin` on, without contacts that lost rows."""
    kind = rows.type[w.id]
    bound = scratch.bound[w.id]
    count = int(0)
    r = int(begin)
    while r < w.rows:
        if whole(kind, r) != _ELLIPTIC:
            r += 1
        else:
            contact = whole(rows.id[w.id], r)
            end = r + rows.dim[contact]
            if end <= w.rows:
                friction = rows.friction[contact]
                if w.lane == 0:
                    put_whole(scratch.first[w.id], count, r)
                    put_whole(scratch.end[w.id], count, end)
                    put(scratch.leaning[w.id], count, 0.0)
                    put(bound, r, friction[0] * impratio)
                    for i in range(r + 1, end):
                        put(bound, i, friction[i - r - 1])
                count += 1
            else:
                for i in range(r + w.lane, w.rows, lane_count()):
                    put(rows.force[w.id], i, 0.0)
            r = end
    return count


@wp.func
def read_rows(rows: Rows, scratch: Scratch, w: World, elliptic: bool) -> None:
    """Compute J a - aref, and with elliptic cones copy J."""
    jacobian = rows.jacobian[w.id]
    acc = scratch.acc[w.id]
    for r in range(w.lane, w.rows, lane_count()):
        total = float(0.0)
        for k in range(0, w.width, 4):
            total += wp.dot(four(jacobian, r * rows.stride + k), four(acc, k))
        put(scratch.jar[w.id], r, total - at(rows.aref[w.id], r))
        put(scratch.weight[w.id], r, 0.0)
        put_whole(rows.state[w.id], r, SATISFIED)
    if elliptic:
        copies = rows.squared[w.id]
        for k in range(w.lane, w.rows * rows.stride, lane_count()):
            put(copies, k, at(jacobian, k))
    lane_sync()


@wp.func
def update_rows(rows: Rows, scratch: Scratch, w: World) -> bool:
    """Compute forces, states and weights of all rows from J a - aref; returns whether the Hessian may have changed."""
    stiffness = rows.D[w.id]
    force = rows.force[w.id]
    state = rows.state[w.id]
    changed = float(0.0)
    for r in range(w.lane, w.rows, lane_count()):
        if whole(rows.type[w.id], r) != _ELLIPTIC:
            jar = at(scratch.jar[w.id], r)
            d = at(stiffness, r)
            now = QUADRATIC
            push = -d * jar
            if r >= w.equalities:
                if r < w.equalities + w.frictions:
                    loss = at(rows.frictionloss[w.id], r)
                    if push >= loss:
                        now = _LINEARNEG
                        push = loss
                    elif push <= -loss:
                        now = _LINEARPOS
                        push = -loss
                elif jar >= 0.0:
                    now = SATISFIED
                    push = 0.0
            weight = wp.where(now == QUADRATIC, d, 0.0)
            if weight != at(scratch.weight[w.id], r):
                changed = 1.0
            put(force, r, push)
            put(scratch.weight[w.id], r, weight)
            put_whole(state, r, now)
    for contact in range(w.lane, w.contacts, lane_count()):
        if update_contact(scratch, w.id, contact, stiffness, force, state):
            changed = 1.0
    lane_sync()
    for contact in range(w.contacts):
        inverse = at(scratch.leaning[w.id], contact)
        if inverse != 0.0:
            lean_rows(
                whole(scratch.first[w.id], contact),
                whole(scratch.end[w.id], contact),
                inverse,
                scratch.jar[w.id],
                scratch.bound[w.id],
                rows.jacobian[w.id],
                rows.stride,
                w.nv,
                w.lane,
                rows.squared[w.id],
            )
    lane_sync()
    return lane_sum(changed) > 0.0


@wp.func
def update_gradient(rows: Rows, scratch: Scratch, smooth: wp.array[float], w: World) -> float:
    """Compute Jᵀ f and the gradient M a - τ - Jᵀ f; returns its squared norm."""
    force = rows.force[w.id]
    jacobian = rows.jacobian[w.id]
    combine(force, jacobian, w.nv, rows.stride, w.rows, w.lane, scratch.push[w.id])
    square = float(0.0)
    for i in range(w.lane, w.nv, lane_count()):
        slope = at(scratch.inertial[w.id], i) - at(smooth, i) - at(scratch.push[w.id], i)
        put(scratch.gradient[w.id], i, slope)
        square += slope * slope
    lane_sync()
    return lane_sum(square)


@wp.func
def factor_hessian(rows: Rows, scratch: Scratch, w: World) -> None:
    """Build and factor the Hessian, M + Σ weight · row rowᵀ."""
    factor = scratch.factor[w.id]
    add_squares(
        scratch.inertia[w.id],
        scratch.weight[w.id],
        rows.squared[w.id],
        w.rows,
        rows.stride,
        w.width,
        w.lane,
        lane_count(),
        factor,
    )
    lane_sync()
    factorize(factor, scratch.pivot[w.id], w.nv, w.width, w.lane, _NAN)
