"""How often a gradient goes through a contact without a derivative of its own, and between which geoms."""

import mujoco
import numpy as np
import warp as wp

from msk_ray.step.adjoint.coverage.contact_kinds import contact_types, geom_pair_name
from msk_ray.step.adjoint.laws.contact_geometry.primitive_laws import CONVEX_PAIRS, STANDING_PAIRS

_TYPES = wp.constant(int(mujoco.mjtGeom.mjNGEOMTYPES))


@wp.struct
class Touches:
    """Where `pull_convex` and `pull_geometry` count."""

    last: wp.array[int]
    """Substep counted last, from 1, in the env step that is pulled back, shape (W,)."""
    count: wp.array[int]
    """World-substeps with such a contact, shape (1,)."""
    example: wp.array[wp.int64]
    """1 + geom1 · ngeom + geom2 of one such contact for each pair of types, else 0; shape (types²,)."""


@wp.func
def count_touch(
    touches: Touches, worldid: int, substep: int, ngeom: int, geom1: int, geom2: int, type1: int, type2: int
) -> None:
    """Count a world once a substep, however many contacts it has."""
    if wp.atomic_exch(touches.last, worldid, substep) != substep:
        wp.atomic_add(touches.count, 0, 1)
    touches.example[type1 * _TYPES + type2] = wp.int64(geom1) * wp.int64(ngeom) + wp.int64(geom2) + wp.int64(1)


class TouchCounter:
    """Counts for one model; `present` tells whether it has such pairs at all.

    Args:
        mjm: the model.
        nworld: number of worlds W.
    """

    def __init__(self, mjm: mujoco.MjModel, nworld: int) -> None:
        self._mjm = mjm
        self.present = bool(contact_types(mjm) & (CONVEX_PAIRS | STANDING_PAIRS))
        self.substep = 0
        self.touches = Touches()
        self.touches.last = wp.zeros(nworld if self.present else 0, dtype=int)
        self.touches.count = wp.zeros(1, dtype=int)
        self.touches.example = wp.zeros(int(_TYPES) ** 2, dtype=wp.int64)

    def start(self) -> None:
        """Launch the beginning of an env step's pullback."""
        self.substep = 0
        if self.present:
            self.touches.last.zero_()

    def read(self) -> tuple[int, list[str]]:
        """World-substeps counted since the last read, and a pair of geoms for each pair of types met so far."""
        count = int(self.touches.count.numpy()[0])
        self.touches.count.zero_()
        codes = np.array(self.touches.example.numpy())
        pairs = [divmod(int(code) - 1, self._mjm.ngeom) for code in codes[codes > 0]]
        return count, [geom_pair_name(self._mjm, *pair) for pair in pairs]

    def clear(self) -> None:
        """Forget what was counted."""
        self.touches.count.zero_()
        self.touches.example.zero_()
