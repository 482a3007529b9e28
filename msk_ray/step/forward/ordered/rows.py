"""Sorts constraint rows by their elements, instead of the order in which threads allocated them."""

from typing import Any

import warp as wp

from msk_ray.step.forward.arrays import allocate, gather
from msk_ray.step.forward.mjw_private import ConstraintType

wp.set_module_options({"enable_backward": False})


@wp.struct
class RowRecords:
    """All arrays of constraint rows before the solver starts, except the Jacobian, (W, R), for moving rows."""

    type: wp.array2d[int]
    id: wp.array2d[int]
    pos: wp.array2d[float]
    margin: wp.array2d[float]
    D: wp.array2d[float]
    vel: wp.array2d[float]
    aref: wp.array2d[float]
    frictionloss: wp.array2d[float]


@wp.func
def copy_row(source: RowRecords, target: RowRecords, worldid: int, i: int, j: int) -> None:
    target.type[worldid, j] = source.type[worldid, i]
    target.id[worldid, j] = source.id[worldid, i]
    target.pos[worldid, j] = source.pos[worldid, i]
    target.margin[worldid, j] = source.margin[worldid, i]
    target.D[worldid, j] = source.D[worldid, i]
    target.vel[worldid, j] = source.vel[worldid, i]
    target.aref[worldid, j] = source.aref[worldid, i]
    target.frictionloss[worldid, j] = source.frictionloss[worldid, i]


@wp.kernel
def sort_rows(
    # In:
    nefc_in: wp.array[int],
    njmax: int,
    rows_in: RowRecords,
    jacobian_in: wp.array3d[float],
    # Out:
    place_out: wp.array2d[int],
    source_out: wp.array2d[int],
    sorted_out: RowRecords,
    jacobian_out: wp.array3d[float],
) -> None:
    """Copy every row to its sorted index: by kind, then by element; rows of one element keep their order.

    Kinds are in mujoco_warp's order, so that its counts of equality, friction and limit rows hold. Rows of one element
    are consecutive, because they are allocated together.
    """
    worldid, row = wp.tid()
    count = wp.min(nefc_in[worldid], njmax)
    if row >= count:
        return
    kind = wp.min(rows_in.type[worldid, row], int(ConstraintType.CONTACT_FRICTIONLESS))
    element = rows_in.id[worldid, row]
    place = int(0)
    for k in range(count):
        other = wp.min(rows_in.type[worldid, k], int(ConstraintType.CONTACT_FRICTIONLESS))
        if other < kind:
            place += 1
        elif other == kind:
            if rows_in.id[worldid, k] < element or (rows_in.id[worldid, k] == element and k < row):
                place += 1
    place_out[worldid, row] = place
    source_out[worldid, place] = row
    if place != row:
        copy_row(rows_in, sorted_out, worldid, row, place)
        for i in range(jacobian_in.shape[2]):
            jacobian_out[worldid, place, i] = jacobian_in[worldid, row, i]


@wp.kernel
def take_back(
    # In:
    nefc_in: wp.array[int],
    njmax: int,
    source_in: wp.array2d[int],
    sorted_in: RowRecords,
    jacobian_in: wp.array3d[float],
    # Out:
    rows_out: RowRecords,
    jacobian_out: wp.array3d[float],
) -> None:
    """Copy back rows whose index has changed."""
    worldid, row = wp.tid()
    if row < wp.min(nefc_in[worldid], njmax) and source_in[worldid, row] != row:
        copy_row(sorted_in, rows_out, worldid, row, row)
        for i in range(jacobian_in.shape[2]):
            jacobian_out[worldid, row, i] = jacobian_in[worldid, row, i]


@wp.kernel
def follow_rows(
    # In:
    nacon_in: wp.array[int],
    worldid_in: wp.array[int],
    place_in: wp.array2d[int],
    # Out:
    address_out: wp.array2d[int],
) -> None:
    """Update every contact's addresses of rows."""
    con = wp.tid()
    if con >= wp.min(nacon_in[0], address_out.shape[0]):
        return
    for k in range(address_out.shape[1]):
        row = address_out[con, k]
        if row >= 0:
            address_out[con, k] = place_in[worldid_in[con], row]


class RowOrder:
    """Sorts the constraint rows of a `mujoco_warp.Data` with a dense Jacobian, after they are built.

    Args:
        data: any Data of the same size as those whose rows are to be sorted.
    """

    def __init__(self, data: Any) -> None:
        shape = (data.nworld, data.njmax)
        self._place, self._source = (wp.zeros(shape, dtype=int) for _ in range(2))
        self._sorted = allocate(RowRecords, *shape)
        self._jacobian = wp.zeros((*shape, data.efc.J.shape[2]), dtype=float)

    def launch(self, data: Any) -> None:
        """Launch the sort."""
        rows, shape = gather(RowRecords, data.efc), (data.nworld, data.njmax)
        wp.launch(
            sort_rows,
            dim=shape,
            inputs=[data.nefc, data.njmax, rows, data.efc.J],
            outputs=[self._place, self._source, self._sorted, self._jacobian],
        )
        wp.launch(
            take_back,
            dim=shape,
            inputs=[data.nefc, data.njmax, self._source, self._sorted, self._jacobian],
            outputs=[rows, data.efc.J],
        )
        wp.launch(
            follow_rows,
            dim=data.naconmax,
            inputs=[data.nacon, data.contact.worldid, self._place],
            outputs=[data.contact.efc_address],
        )
