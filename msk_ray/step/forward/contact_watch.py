"""Contacts between groups of geoms in each substep of an env step, as the solver found them. Values only: no gradient.

Axes: S substeps, W worlds, G geoms, n primary groups of a query.
"""

from typing import Any, NamedTuple

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

FIGURES = 5
"""Figures of a primary group: force on it in world coordinates [N] (3), number of contacts, largest force of one."""

_PRIMARY, _SECONDARY = wp.constant(1), wp.constant(2)


class ContactQuery(NamedTuple):
    """Which contacts count: those between a primary group of geoms and the secondary one."""

    primary: tuple[tuple[int, ...], ...]
    """Ids of the geoms in each of n groups."""
    secondary: tuple[int, ...]
    """Ids of the geoms that they touch."""


def geoms_of(model: mujoco.MjModel, kind: str, ident: int) -> tuple[int, ...]:
    """Ids of the geoms of a `geom` (itself), `body`, `site` (its body) or `subtree` (of a body)."""
    if kind == "geom":
        return (ident,)
    body = int(model.site_bodyid[ident]) if kind == "site" else ident
    bodies = {body}
    if kind == "subtree":
        for b in range(body + 1, model.nbody):
            if int(model.body_parentid[b]) in bodies:
                bodies.add(b)
    return tuple(g for g in range(model.ngeom) if int(model.geom_bodyid[g]) in bodies)


@wp.kernel(enable_backward=False)
def sum_by_group(
    # Data in:
    nacon_in: wp.array[int],
    contact_worldid_in: wp.array[int],
    contact_geom_in: wp.array[wp.vec2i],
    contact_efc_address_in: wp.array2d[int],
    # In:
    group_in: wp.array2d[int],
    force_in: wp.array[wp.spatial_vector],
    # Out:
    figures_out: wp.array3d[float],
) -> None:
    """Adds each contact with constraint rows between the two sides of a group to its figures.

    A contact's force acts on the second geom of its pair. If both geoms are in both sides, the first one is primary.
    """
    contactid, group = wp.tid()
    if contactid >= nacon_in[0] or contact_efc_address_in[contactid, 0] < 0:
        return
    geoms = contact_geom_in[contactid]
    first = group_in[group, geoms[0]]
    second = group_in[group, geoms[1]]
    in_order = (first & _PRIMARY) != 0 and (second & _SECONDARY) != 0
    reversed = (second & _PRIMARY) != 0 and (first & _SECONDARY) != 0
    if not in_order and not reversed:
        return
    sign = wp.where(in_order, -1.0, 1.0)
    worldid = contact_worldid_in[contactid]
    wrench = force_in[contactid]
    for i in range(3):
        wp.atomic_add(figures_out, worldid, group, i, sign * wrench[i])
    wp.atomic_add(figures_out, worldid, group, 3, 1.0)
    wp.atomic_max(figures_out, worldid, group, 4, wp.length(wp.spatial_top(wrench)))


class ContactWatch:
    """Answers queries about the contacts of each substep.

    Args:
        model, data: a batch's.
        substeps: number of substeps S of an env step.

    Attributes:
        queries: those that every step answers from its next recording on.
        figures: answer to each of them, `FIGURES` numbers for each world and primary group, (S, W, n, FIGURES).
    """

    def __init__(self, model: Any, data: Any, substeps: int) -> None:
        self._model, self._substeps, self._nworld = model, substeps, data.nworld
        self._device = data.qpos.device
        self._ngeom, self._contacts = model.ngeom, data.naconmax
        self._groups: dict[ContactQuery, wp.array] = {}
        self._scratch: tuple[wp.array, wp.array] | None = None
        self.figures: dict[ContactQuery, wp.array] = {}

    @property
    def queries(self) -> tuple[ContactQuery, ...]:
        """All queries, in the order in which they were added."""
        return tuple(self.figures)

    def add(self, query: ContactQuery) -> None:
        """Answer another query. Arrays of earlier ones stay where they are."""
        if query in self.figures:
            return
        groups = np.zeros((len(query.primary), self._ngeom), dtype=np.int32)
        for row, primary in zip(groups, query.primary, strict=True):
            row[list(primary)] |= int(_PRIMARY)
        groups[:, list(query.secondary)] |= int(_SECONDARY)
        with wp.ScopedDevice(self._device):
            self._groups[query] = wp.array(groups, dtype=int)
            self.figures[query] = wp.zeros((self._substeps, self._nworld, len(groups), FIGURES), dtype=float)
            if self._scratch is None:
                ids = wp.array(np.arange(self._contacts, dtype=np.int32), dtype=int)
                self._scratch = ids, wp.zeros(self._contacts, dtype=wp.spatial_vector)

    def launch(self, data: Any, substep: int) -> None:
        """Launch the answers for a substep that was just computed in `data`."""
        if self._scratch is None:
            return
        ids, wrenches = self._scratch
        mjw.contact_force(self._model, data, ids, True, wrenches)
        contact = data.contact
        for query, figures in self.figures.items():
            figures[substep].zero_()
            wp.launch(
                sum_by_group,
                dim=(self._contacts, len(query.primary)),
                inputs=[data.nacon, contact.worldid, contact.geom, contact.efc_address, self._groups[query], wrenches],
                outputs=[figures[substep]],
                device=self._device,
            )
