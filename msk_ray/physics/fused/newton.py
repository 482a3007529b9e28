"""Newton's method for the constraint forces of a world, by one thread from the first iteration to the last."""

import warp as wp
from mujoco_warp import OverflowType

from msk_ray.physics.fused.blocks import multiply, solve_factored
from msk_ray.physics.fused.line_search import search_line
from msk_ray.physics.fused.memory import entry, four, number, put_entry, put_four, whole
from msk_ray.physics.fused.problem import (
    RowsIn,
    World,
    factor_hessian,
    read_rows,
    update_gradient,
    update_rows,
)
from msk_ray.physics.fused.scratch import Scratch
from msk_ray.physics.mjw_private import MJ_MINVAL

wp.set_module_options({"enable_backward": False})

_ITERATIONS = wp.constant(int(OverflowType.ITERATIONS))
_LS_ITERATIONS = wp.constant(int(OverflowType.LS_ITERATIONS))
_MIN = wp.constant(float(MJ_MINVAL))


@wp.struct
class Solution:
    """What the solver leaves in mujoco_warp's Data."""

    qacc: wp.array2d[float]
    Ma: wp.array2d[float]
    qfrc_constraint: wp.array2d[float]
    force: wp.array2d[float]
    state: wp.array2d[int]
    solver_niter: wp.array[int]
    overflow: wp.array[int]


@wp.struct
class Limits:
    """When the solver stops."""

    tolerance: wp.array[float]
    ls_tolerance: wp.array[float]
    iterations: int
    ls_iterations: int


@wp.func
def read_inertia(
    rownnz: wp.array[int],
    rowadr: wp.array[int],
    colind: wp.array[int],
    inertia: wp.array2d[float],
    scratch: Scratch,
    w: World,
) -> float:
    """Copy M, and return its trace."""
    trace = float(0.0)
    for i in range(w.nv):
        for k in range(rowadr[i], rowadr[i] + rownnz[i]):
            j = colind[k]
            value = number(inertia, w.id, k)
            put_entry(scratch.inertia, w.id, 4 * i * w.blocks + j, value)
            put_entry(scratch.inertia, w.id, 4 * j * w.blocks + i, value)
            if i == j:
                trace += value
    return trace


@wp.func
def advance_rows(scratch: Scratch, w: World, begin: int, end: int, alpha: float) -> None:
    for p in range(begin, end):
        row = four(scratch.springs, w.id, p)
        put_four(scratch.springs, w.id, p, wp.vec4(row[0], row[1], row[2] + alpha * row[3], row[3]))


@wp.func
def advance(scratch: Scratch, w: World, alpha: float) -> None:
    """Move along the direction."""
    for k in range(w.blocks):
        put_four(scratch.acc, w.id, k, four(scratch.acc, w.id, k) + alpha * four(scratch.direction, w.id, k))
        put_four(scratch.inertial, w.id, k, four(scratch.inertial, w.id, k) + alpha * four(scratch.moved, w.id, k))
    advance_rows(scratch, w, 0, w.contact_rows, alpha)
    advance_rows(scratch, w, w.room - w.scalars, w.room, alpha)


@wp.func
def find_direction(scratch: Scratch, w: World) -> wp.vec2:
    """Newton's direction s = -H⁻¹ g, with |s|² and -g·s."""
    solve_factored(scratch.factor, w.id, scratch.gradient, w.blocks, scratch.direction)
    square = float(0.0)
    decrement = float(0.0)
    for k in range(w.blocks):
        s = four(scratch.direction, w.id, k)
        square += wp.dot(s, s)
        decrement -= wp.dot(s, four(scratch.gradient, w.id, k))
    return wp.vec2(square, decrement)


@wp.func
def iterate(scratch: Scratch, w: World, limits: Limits, scale: float, out: Solution) -> None:
    """Newton's iterations from the present acceleration on; `scale` is the reciprocal of the trace of M."""
    tolerance = limits.tolerance[w.id % limits.tolerance.shape[0]]
    ls_tolerance = limits.ls_tolerance[w.id % limits.ls_tolerance.shape[0]]
    update_rows(scratch, w)
    update_gradient(scratch, w)
    factor_hessian(scratch, w)
    found = find_direction(scratch, w)
    done = bool(False)
    count = int(0)
    while count < limits.iterations and not done:
        multiply(scratch.inertia, w.id, scratch.direction, w.blocks, scratch.moved)
        least = tolerance * ls_tolerance * wp.sqrt(found[0]) / scale
        alpha, gain, exact = search_line(scratch, w, least, limits.ls_iterations)
        if not exact:
            out.overflow[w.id] = out.overflow[w.id] | _LS_ITERATIONS
        advance(scratch, w, alpha)
        changed = update_rows(scratch, w)
        slope = scale * wp.sqrt(update_gradient(scratch, w))
        count += 1
        done = alpha == 0.0 or (gain > 0.0 and scale * gain < tolerance) or slope < tolerance
        if not done:
            if changed:
                factor_hessian(scratch, w)
            found = find_direction(scratch, w)
            done = 0.5 * scale * found[1] < tolerance
    if not done and limits.iterations > 0:
        out.overflow[w.id] = out.overflow[w.id] | _ITERATIONS
    out.solver_niter[w.id] = count


@wp.func
def write_rows(scratch: Scratch, w: World, begin: int, end: int, out: Solution) -> None:
    for p in range(begin, end):
        source = whole(scratch.source, w.id, p)
        out.force[w.id, source] = number(scratch.force, w.id, p)
        out.state[w.id, source] = whole(scratch.state, w.id, p)


@wp.kernel
def solve_world(
    # Model:
    nv: int,
    M_rownnz: wp.array[int],
    M_rowadr: wp.array[int],
    M_colind: wp.array[int],
    opt_impratio_invsqrt: wp.array[float],
    limits: Limits,
    warm: bool,
    lanes: int,
    # In:
    ne_in: wp.array[int],
    nf_in: wp.array[int],
    nefc_in: wp.array[int],
    njmax: int,
    inertia_in: wp.array2d[float],
    qfrc_smooth_in: wp.array2d[float],
    qacc_smooth_in: wp.array2d[float],
    qacc_warmstart_in: wp.array2d[float],
    rows_in: RowsIn,
    # Out:
    scratch: Scratch,
    out: Solution,
) -> None:
    """The acceleration of least cost of one world, and the forces there. Without rows it is the smooth one.

    The first `lanes` threads of 32 have a world each, and the others none.
    """
    thread = wp.tid()
    lane = thread % 32
    world = thread // 32 * lanes + lane
    if lane >= lanes or world >= nefc_in.shape[0]:
        return
    count = wp.min(nefc_in[world], njmax)
    if count == 0:
        for i in range(nv):
            out.qacc[world, i] = qacc_smooth_in[world, i]
            out.Ma[world, i] = qfrc_smooth_in[world, i]
            out.qfrc_constraint[world, i] = 0.0
        out.solver_niter[world] = 0
        return
    w = World()
    w.id = world
    w.nv = nv
    w.blocks = (nv + 3) // 4
    w.room = njmax
    w.equalities = ne_in[world]
    w.frictions = nf_in[world]
    trace = read_inertia(M_rownnz, M_rowadr, M_colind, inertia_in, scratch, w)
    for i in range(nv):
        acc = qacc_smooth_in[world, i]
        if warm:
            acc = qacc_warmstart_in[world, i]
        put_entry(scratch.acc, world, i, acc)
        put_entry(scratch.smooth, world, i, qfrc_smooth_in[world, i])
    w = read_rows(rows_in, scratch, w, count, opt_impratio_invsqrt[world % opt_impratio_invsqrt.shape[0]])
    multiply(scratch.inertia, world, scratch.acc, w.blocks, scratch.inertial)
    iterate(scratch, w, limits, 1.0 / wp.max(_MIN, trace), out)
    for i in range(nv):
        out.qacc[world, i] = entry(scratch.acc, world, i)
        out.Ma[world, i] = entry(scratch.inertial, world, i)
        out.qfrc_constraint[world, i] = entry(scratch.push, world, i)
    write_rows(scratch, w, 0, w.contact_rows, out)
    write_rows(scratch, w, w.room - w.scalars, w.room, out)
