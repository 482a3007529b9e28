"""The laws f(J a - aref) of all constraint rows at the known acceleration, whatever each row constrains.

Row laws (design of MuJoCo's solver): limits, frictionless and pyramidal rows f = -D·jar where jar < 0; equality
f = -D·jar; friction loss the same, clamped. Elliptic contacts couple their rows (`cones`) and are finished in
`contacts`.
"""

import warp as wp

from msk_ray.step.adjoint.groups import Contacts, RowLaws, Rows, Substep, allocate_rows
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.cone_law import QUADRATIC, SLIDING, cone_mass, zone
from msk_ray.step.forward.fused.cones import lean_rows, lean_weights
from msk_ray.step.forward.fused.lanes import at, lane_count, lane_sync, put
from msk_ray.step.forward.mjw_private import ConstraintType

wp.set_module_options({"enable_backward": False})

_SLOTS = 32
"""Rows of a world that a GPU works on at the same time. Few worlds have more, while the buffer has room for many."""


@wp.struct
class Squares:
    """The constraint part of the Hessian, JᵀSJ, as Σ weight · row rowᵀ; (W, R), and the rows (W, ...) as J's lie."""

    weight: wp.array2d[float]
    """With elliptic cones; without, the weights are the slopes."""
    bound: wp.array2d[float]
    """μ in the first row of an elliptic contact, the friction coefficients in its other rows."""
    leaning: wp.array2d[float]
    """1 / T in the first row of an elliptic contact that slides, else 0."""
    rows: wp.array2d[float]


@wp.kernel
def densify_rows(
    # In:
    nefc_in: wp.array[int],
    rownnz_in: wp.array2d[int],
    rowadr_in: wp.array2d[int],
    colind_in: wp.array3d[int],
    sparse_in: wp.array3d[float],
    # Out:
    dense_out: wp.array3d[float],
) -> None:
    """Sparse constraint Jacobian to (W, njmax, nv)."""
    worldid, row = wp.tid()
    if row >= nefc_in[worldid]:
        return
    for j in range(dense_out.shape[2]):
        dense_out[worldid, row, j] = 0.0
    start = rowadr_in[worldid, row]
    for k in range(start, start + rownnz_in[worldid, row]):
        # A column may come twice (two bodies of one chain), so entries add up.
        dense_out[worldid, row, colind_in[worldid, 0, k]] += sparse_in[worldid, 0, k]


# This law stands in three more places, which share no function because none computes what another does, to the bit:
# `update_rows` in `forward/fused/problem.py` keeps the row's state, goes by the row's place and not its type, and lets
# a NaN of jar push, where a row pushes nothing here; `forward/fused/line_search.py` has costs as differences from the
# start of a line, which do not cancel; `row_potential` has the force as a function of what sets D and aref, for
# `wp.grad`, with the state held that was found here.
@wp.kernel
def row_laws(
    # Model:
    nv: int,
    # In:
    slots: int,
    nefc_in: wp.array[int],
    rows_in: Rows,
    jacobian_in: wp.array3d[float],
    qacc_in: wp.array2d[float],
    # Out:
    laws_out: RowLaws,
) -> None:
    """jar = J a - aref, the force f of uncoupled rows, and their slope s = -∂f/∂jar. Elliptic rows get f = s = 0.

    `slots` threads take all rows of a world in turn.
    """
    worldid, slot = wp.tid()
    for row in range(slot, wp.min(nefc_in[worldid], laws_out.jar.shape[1]), slots):
        jar = -rows_in.aref[worldid, row]
        for j in range(nv):
            jar += jacobian_in[worldid, row, j] * qacc_in[worldid, j]
        d = rows_in.D[worldid, row]
        kind = rows_in.type[worldid, row]
        force = float(0.0)
        slope = float(0.0)
        if kind == ConstraintType.EQUALITY:
            force = -d * jar
            slope = d
        elif kind == ConstraintType.FRICTION_DOF or kind == ConstraintType.FRICTION_TENDON:
            loss = rows_in.frictionloss[worldid, row]
            force = wp.clamp(-d * jar, -loss, loss)
            slope = wp.where(wp.abs(d * jar) < loss, d, 0.0)
        elif kind != ConstraintType.CONTACT_ELLIPTIC and jar < 0.0:
            force = -d * jar
            slope = d
        laws_out.jar[worldid, row] = jar
        laws_out.force[worldid, row] = force
        laws_out.slope[worldid, row] = slope


@wp.func
def weigh_row(
    worldid: int,
    row: int,
    impratio: float,
    rows_in: Rows,
    laws_in: RowLaws,
    contacts_in: Contacts,
    out: Squares,
) -> None:
    """Weight of a row of an elliptic contact, and what `square_rows` reads of the contact."""
    con = rows_in.id[worldid, row]
    first = contacts_in.efc_address[con, 0]
    jar = laws_in.jar[worldid]
    mu = contacts_in.friction[con][0] * impratio
    normal = mu * at(jar, first)
    squares = float(0.0)
    for i in range(1, contacts_in.dim[con]):
        u = contacts_in.friction[con][i - 1] * at(jar, first + i)
        squares += u * u
    tangent = wp.sqrt(squares)
    state = zone(normal, tangent, mu)
    weight = float(0.0)
    inverse = float(0.0)
    if state == QUADRATIC:
        weight = rows_in.D[worldid, row]
    elif state == SLIDING:
        inverse = 1.0 / tangent
        weights = lean_weights(cone_mass(rows_in.D[worldid, first], mu), mu, normal, inverse)
        weight = wp.where(row == first, weights[0], weights[1])
    put(out.weight[worldid], row, weight)
    put(out.leaning[worldid], row, inverse)
    if row == first:
        put(out.bound[worldid], row, mu)
    else:
        put(out.bound[worldid], row, contacts_in.friction[con][row - first - 1])


@wp.func
def square_rows(
    worldid: int,
    count: int,
    lane: int,
    impratio: float,
    rows_in: Rows,
    jacobian: wp.array[float],
    stride: int,
    laws_in: RowLaws,
    contacts_in: Contacts,
    out: Squares,
) -> None:
    """Weights and rows whose squares add up to JᵀSJ, with all lanes of a world; for elliptic cones, whose S couples the
    rows of a contact."""
    for row in range(lane, count, lane_count()):
        if rows_in.type[worldid, row] == ConstraintType.CONTACT_ELLIPTIC:
            weigh_row(worldid, row, impratio, rows_in, laws_in, contacts_in, out)
        else:
            put(out.weight[worldid], row, laws_in.slope[worldid, row])
            put(out.leaning[worldid], row, 0.0)
    lane_sync()
    first = int(0)
    while first < count:
        end = first + 1
        if rows_in.type[worldid, first] == ConstraintType.CONTACT_ELLIPTIC:
            end = wp.min(first + contacts_in.dim[rows_in.id[worldid, first]], count)
        inverse = at(out.leaning[worldid], first)
        lean_rows(
            first,
            end,
            inverse,
            laws_in.jar[worldid],
            out.bound[worldid],
            jacobian,
            stride,
            stride,
            lane,
            out.rows[worldid],
        )
        first = end
    lane_sync()


class ConstraintLaws:
    """Launches of everything about constraint rows that depends on the acceleration alone.

    Attributes:
        squares: where the rows of the Hessian are worked out with elliptic cones; of no size for others.
    """

    def __init__(self, work: Workspace) -> None:
        self._work = work
        shape = (work.nworld, work.njmax, work.jacobian_width)
        worlds = work.nworld if work.settings.elliptic else 0
        self.squares = allocate_rows(Squares, worlds, {"rows": shape[1] * shape[2]}, work.njmax)
        self._dense = wp.zeros(shape, dtype=float) if work.model.is_sparse else None

    def launch(self, at: Substep) -> None:
        """Launch the Jacobian as a full matrix, and the laws."""
        work = self._work
        if self._dense is not None:
            efc = at.data.efc
            sparse = {"rownnz": efc.J_rownnz, "rowadr": efc.J_rowadr, "colind": efc.J_colind, "sparse": efc.J}
            work.launch(densify_rows, (work.nworld, work.njmax), at, dense=self._dense, **sparse)
            at.jacobian = self._dense
        slots = work.lanes(min(_SLOTS, work.njmax), meet=False)
        work.launch(row_laws, (work.nworld, slots), at, slots=slots)
