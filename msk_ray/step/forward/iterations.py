"""Counts the constraint solver's iterations on the device."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

MOST_COUNTED = 127
"""Largest number of iterations counted; worlds that take more count as this many."""


@wp.kernel(enable_backward=False)
def count_iterations(
    # In:
    niter_in: wp.array[int],
    substep: int,
    # Out:
    counts_out: wp.array2d[int],
) -> None:
    """Add a world to the count for its number of iterations."""
    world = wp.tid()
    wp.atomic_add(counts_out, substep, wp.min(niter_in[world], counts_out.shape[1] - 1), 1)


class IterationWatch:
    """Counts worlds by the iterations that they took, for each substep of an env step.

    Args:
        substeps: number of substeps S of an env step.
        nworld: number of worlds.
        device: their device.
    """

    def __init__(self, substeps: int, nworld: int, device: wp.Device) -> None:
        self._nworld = nworld
        self._counts = wp.zeros((substeps, MOST_COUNTED + 1), dtype=int, device=device)

    def launch(self, data: Any, substep: int) -> None:
        """Launch the count for a substep that was just computed in `data`."""
        wp.launch(
            count_iterations,
            dim=self._nworld,
            inputs=[data.solver_niter, substep],
            outputs=[self._counts],
            device=self._counts.device,
        )

    def read(self) -> NDArray[np.int64]:
        """World counts by substep and iterations, (S, 1 + MOST_COUNTED); resets them. Waits for the steps."""
        counts = np.array(self._counts.numpy(), dtype=np.int64)
        self._counts.zero_()
        return counts


def limits_for(counts: NDArray[np.int64], rare: float) -> tuple[int, ...]:
    """For each substep, the smallest number of iterations, at least 1, that at most this share of the worlds reach.

    Args:
        counts: world counts by substep and iterations, (S, N).
        rare: a share.
    """
    total = np.maximum(counts.sum(axis=1, keepdims=True), 1)
    reaching = np.cumsum(counts[:, ::-1], axis=1)[:, ::-1] / total  # share of worlds with at least that many
    return tuple(max(1, int(n)) for n in (reaching > rare).sum(axis=1))


def reached(counts: NDArray[np.int64], limits: tuple[int, ...]) -> tuple[float, ...]:
    """Share of worlds that reached the iteration limit, for each substep."""
    total = np.maximum(counts.sum(axis=1), 1)
    return tuple(float(row[limit:].sum() / n) for row, limit, n in zip(counts, limits, total, strict=True))
