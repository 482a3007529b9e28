"""Constraint rows at the known acceleration: their laws f(J a - aref).

Row laws (design of MuJoCo's solver): limits, frictionless and pyramidal rows f = -D·jar where jar < 0; equality
f = -D·jar; friction loss the same, clamped. Elliptic contacts couple their rows (`cones`) and are finished in
`contacts`.
"""

import warp as wp

from msk_ray.step.adjoint.groups import Contacts, RowLaws, Rows, Substep
from msk_ray.step.adjoint.laws.cones import cone_law, cone_slope, vec6
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.mjw_private import ConstraintType

wp.set_module_options({"enable_backward": False})

_SLOTS = 32
"""Rows of a world that a GPU works on at the same time. Few worlds have more, while the buffer has room for many."""
_LANES = 2
"""Threads of a GPU that share a row of S J, each of which works out the law of the row's contact. A thread for each
entry of the whole buffer took 150 µs for 4096 ants on an H200, and two for each of its rows 75."""


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
def scale_row(
    worldid: int,
    row: int,
    lane: int,
    lanes: int,
    # Model:
    nv: int,
    impratio_invsqrt: float,
    # In:
    rows_in: Rows,
    jacobian_in: wp.array3d[float],
    laws_in: RowLaws,
    contacts_in: Contacts,
    # Out:
    scaled_out: wp.array3d[float],
) -> None:
    """Rows of S J that belong to one row: its own, or all of the contact whose first it is."""
    if rows_in.type[worldid, row] != ConstraintType.CONTACT_ELLIPTIC:
        for dof in range(lane, nv, lanes):
            scaled_out[worldid, row, dof] = laws_in.slope[worldid, row] * jacobian_in[worldid, row, dof]
        return
    con = rows_in.id[worldid, row]
    if row != contacts_in.efc_address[con, 0]:
        return  # the threads of the contact's first row write all of them
    dim = contacts_in.dim[con]
    jar = vec6()
    mass = vec6()
    for i in range(dim):
        jar[i] = laws_in.jar[worldid, row + i]
        mass[i] = rows_in.D[worldid, row + i]
    friction = contacts_in.friction[con]
    cone = cone_law(jar, mass, friction, friction[0] * impratio_invsqrt, dim)
    for dof in range(lane, nv, lanes):
        column = vec6()
        for i in range(dim):
            column[i] = jacobian_in[worldid, row + i, dof]
        product = cone_slope(cone, mass, friction, dim, column)
        for i in range(dim):
            scaled_out[worldid, row + i, dof] = product[i]


@wp.kernel
def scaled_jacobian(
    # Model:
    nv: int,
    opt_impratio_invsqrt: wp.array[float],
    # In:
    slots: int,
    lanes: int,
    nefc_in: wp.array[int],
    rows_in: Rows,
    jacobian_in: wp.array3d[float],
    laws_in: RowLaws,
    contacts_in: Contacts,
    # Out:
    scaled_out: wp.array3d[float],
) -> None:
    """S J; needed for elliptic cones only, whose S couples the rows of a contact.

    `slots` groups of `lanes` threads take all rows of a world in turn.
    """
    worldid, slot, lane = wp.tid()
    impratio = opt_impratio_invsqrt[worldid % opt_impratio_invsqrt.shape[0]]
    for row in range(slot, wp.min(nefc_in[worldid], laws_in.jar.shape[1]), slots):
        scale_row(worldid, row, lane, lanes, nv, impratio, rows_in, jacobian_in, laws_in, contacts_in, scaled_out)


class ConstraintLaws:
    """Launches of everything about constraint rows that depends on the acceleration alone.

    Attributes:
        scaled: S J for elliptic cones, shape (W, njmax, nv).
    """

    def __init__(self, work: Workspace) -> None:
        self._work = work
        shape = (work.nworld, work.njmax, work.mjm.nv)
        self.scaled = wp.zeros(shape if work.settings.elliptic else (1, 1, 1), dtype=float)
        self._dense = wp.zeros(shape, dtype=float) if work.model.is_sparse else None

    def launch(self, at: Substep) -> None:
        """Launch the Jacobian as a full matrix, the laws and S J."""
        work = self._work
        if self._dense is not None:
            efc = at.data.efc
            sparse = {"rownnz": efc.J_rownnz, "rowadr": efc.J_rowadr, "colind": efc.J_colind, "sparse": efc.J}
            work.launch(densify_rows, (work.nworld, work.njmax), at, dense=self._dense, **sparse)
            at.jacobian = self._dense
        slots = work.lanes(min(_SLOTS, work.njmax), meet=False)
        work.launch(row_laws, (work.nworld, slots), at, slots=slots)
        if work.settings.elliptic:
            lanes = work.lanes(_LANES, meet=False)
            work.launch(scaled_jacobian, (work.nworld, slots, lanes), at, slots=slots, lanes=lanes, scaled=self.scaled)
