"""Lengths and Jacobians of tendons, summed element by element along their paths.

In mujoco_warp, every joint, pair of sites and geom on a tendon has a thread that adds to the tendon's length. Here its
public `tendon` runs on the first elements of all tendons, then on the second ones, and so on, so that no two threads of
a run share a tendon.
"""

import copy
from typing import Any

import mujoco_warp as mjw
import numpy as np
import warp as wp

from msk_ray.step.forward.arrays import add_into

_KINDS = ("jnt", "site_pair", "geom")
"""Kinds of elements, each with two arrays of the model: the elements' tendons, and their addresses."""


class TendonOrder:
    """Launches of the lengths and Jacobians of all tendons.

    Args:
        model: mujoco_warp's model, before it is sealed.
    """

    def __init__(self, model: Any) -> None:
        self._parts: list[Any] = []
        ranks = {kind: _rank(getattr(model, f"tendon_{kind}_adr").numpy()) for kind in _KINDS}
        for k in range(1 + max((int(r.max()) for r in ranks.values() if r.size), default=-1)):
            part = copy.copy(model)
            # Points of the path are for drawing only, and unused here.
            part.tendon_num = wp.zeros_like(model.tendon_num)
            for kind, rank in ranks.items():
                for name in (f"tendon_{kind}_adr", f"wrap_{kind}_adr"):
                    setattr(part, name, wp.array(getattr(model, name).numpy()[rank == k], dtype=int))
            self._parts.append(part)
        self._scratch: dict[int, tuple[wp.array, wp.array]] = {}

    def launch(self, data: Any) -> None:
        """Launch them, into `data.ten_length` and `data.ten_J`."""
        totals = (data.ten_length, data.ten_J)
        if data.nworld not in self._scratch:
            length, jacobian = (wp.zeros_like(total) for total in totals)
            self._scratch[data.nworld] = length, jacobian
        parts = self._scratch[data.nworld]
        own = copy.copy(data)
        own.ten_length, own.ten_J = parts
        for total in totals:
            total.zero_()
        for model in self._parts:
            mjw.tendon(model, own)
            for part, total in zip(parts, totals, strict=True):
                wp.launch(add_into, dim=total.shape, inputs=[part], outputs=[total])


def _rank(tendons: np.ndarray) -> np.ndarray:
    """For each element, its position along its tendon, from 0."""
    seen: dict[int, int] = {}
    ranks = []
    for tendon in tendons:
        ranks.append(seen.get(int(tendon), 0))
        seen[int(tendon)] = ranks[-1] + 1
    return np.array(ranks, dtype=int)
