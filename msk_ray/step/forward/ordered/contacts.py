"""Sorts contacts by world, geoms and number, instead of the order in which threads found them."""

from typing import Any

import warp as wp

from msk_ray.step.forward.arrays import allocate, gather
from msk_ray.step.forward.contact_records import ContactRecords, copy_contact

wp.set_module_options({"enable_backward": False})


@wp.func
def is_before(contacts: ContactRecords, i: int, j: int) -> bool:
    """Whether contact i of a world comes before its contact j. Equal keys are at the same place in the sorted order."""
    a, b = contacts.geom[i], contacts.geom[j]
    if a[0] != b[0]:
        return a[0] < b[0]
    if a[1] != b[1]:
        return a[1] < b[1]
    if contacts.geomcollisionid[i] != contacts.geomcollisionid[j]:
        return contacts.geomcollisionid[i] < contacts.geomcollisionid[j]
    if contacts.dist[i] != contacts.dist[j]:
        return contacts.dist[i] < contacts.dist[j]
    p, q = contacts.pos[i], contacts.pos[j]
    for k in range(3):
        if p[k] != q[k]:
            return p[k] < q[k]
    return i < j


@wp.kernel
def clear(
    # Out:
    count_out: wp.array[int],
    taken_out: wp.array[int],
) -> None:
    worldid = wp.tid()
    count_out[worldid] = 0
    taken_out[worldid] = 0


@wp.kernel
def count_contacts(
    # In:
    nacon_in: wp.array[int],
    worldid_in: wp.array[int],
    # Out:
    count_out: wp.array[int],
) -> None:
    con = wp.tid()
    if con < wp.min(nacon_in[0], worldid_in.shape[0]):
        wp.atomic_add(count_out, worldid_in[con], 1)


@wp.kernel
def sum_blocks(
    # In:
    count_in: wp.array[int],
    width: int,
    # Out:
    block_out: wp.array[int],
) -> None:
    """Contacts in each block of `width` worlds."""
    block = wp.tid()
    total = int(0)
    for world in range(block * width, wp.min((block + 1) * width, count_in.shape[0])):
        total += count_in[world]
    block_out[block] = total


@wp.kernel
def find_first(
    # In:
    count_in: wp.array[int],
    block_in: wp.array[int],
    width: int,
    # Out:
    first_out: wp.array[int],
) -> None:
    """Index of each world's first contact in the sorted list."""
    worldid = wp.tid()
    block = worldid // width
    first = int(0)
    for k in range(block):
        first += block_in[k]
    for world in range(block * width, worldid):
        first += count_in[world]
    first_out[worldid] = first


@wp.kernel
def gather_by_world(
    # In:
    nacon_in: wp.array[int],
    worldid_in: wp.array[int],
    first_in: wp.array[int],
    # Out:
    taken_out: wp.array[int],
    member_out: wp.array[int],
) -> None:
    """Group contacts by world, in any order within a world: the next kernel does not depend on it."""
    con = wp.tid()
    if con < wp.min(nacon_in[0], worldid_in.shape[0]):
        worldid = worldid_in[con]
        member_out[first_in[worldid] + wp.atomic_add(taken_out, worldid, 1)] = con


@wp.kernel
def sort_into(
    # In:
    nacon_in: wp.array[int],
    count_in: wp.array[int],
    first_in: wp.array[int],
    member_in: wp.array[int],
    contacts_in: ContactRecords,
    # Out:
    source_out: wp.array[int],
    sorted_out: ContactRecords,
) -> None:
    """Copy every contact to its index in the sorted list."""
    i = wp.tid()
    if i >= wp.min(nacon_in[0], member_in.shape[0]):
        return
    con = member_in[i]
    worldid = contacts_in.worldid[con]
    first = first_in[worldid]
    place = first
    for k in range(first, first + count_in[worldid]):
        if is_before(contacts_in, member_in[k], con):
            place += 1
    source_out[place] = con
    if place != con:
        copy_contact(contacts_in, con, sorted_out, place)


@wp.kernel
def take_back(
    # In:
    nacon_in: wp.array[int],
    source_in: wp.array[int],
    sorted_in: ContactRecords,
    # Out:
    contacts_out: ContactRecords,
) -> None:
    """Copy back contacts whose index has changed."""
    i = wp.tid()
    if i < wp.min(nacon_in[0], source_in.shape[0]) and source_in[i] != i:
        copy_contact(sorted_in, i, contacts_out, i)


class ContactOrder:
    """Sorts the contacts of a `mujoco_warp.Data`, between collision detection and the constraint rows.

    Args:
        data: any Data of the same size as the Data whose contacts are to be sorted.
    """

    def __init__(self, data: Any) -> None:
        worlds, room = data.nworld, data.naconmax
        self._width = max(1, round(worlds**0.5))
        blocks = -(-worlds // self._width)
        self._count, self._first, self._taken = (wp.zeros(worlds, dtype=int) for _ in range(3))
        self._block = wp.zeros(blocks, dtype=int)
        self._member, self._source = (wp.zeros(room, dtype=int) for _ in range(2))
        self._sorted = allocate(ContactRecords, room)

    def launch(self, data: Any) -> None:
        """Launch the sort."""
        contacts = gather(ContactRecords, data.contact)
        worlds, room = data.nworld, data.naconmax
        wp.launch(clear, dim=worlds, outputs=[self._count, self._taken])
        wp.launch(count_contacts, dim=room, inputs=[data.nacon, contacts.worldid], outputs=[self._count])
        wp.launch(sum_blocks, dim=len(self._block), inputs=[self._count, self._width], outputs=[self._block])
        wp.launch(find_first, dim=worlds, inputs=[self._count, self._block, self._width], outputs=[self._first])
        wp.launch(
            gather_by_world,
            dim=room,
            inputs=[data.nacon, contacts.worldid, self._first],
            outputs=[self._taken, self._member],
        )
        wp.launch(
            sort_into,
            dim=room,
            inputs=[data.nacon, self._count, self._first, self._member, contacts],
            outputs=[self._source, self._sorted],
        )
        wp.launch(take_back, dim=room, inputs=[data.nacon, self._source, self._sorted], outputs=[contacts])
