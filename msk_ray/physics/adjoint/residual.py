"""How far from its optimum the solver stopped: the adjoint's formula holds at the optimum only."""

from typing import Any

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def residual_squares(
    # Model:
    inertia_address: wp.array2d[int],
    # In:
    inertia_in: wp.array2d[float],
    qacc_in: wp.array2d[float],
    smooth_in: wp.array2d[float],
    constraint_in: wp.array2d[float],
    # Out:
    gap_out: wp.array[float],
    size_out: wp.array[float],
) -> None:
    """Adds one dof's (Ma - τ - Jᵀf)² to its world's gap, and (Ma)² + τ² + (Jᵀf)² to its size."""
    worldid, i = wp.tid()
    product = float(0.0)
    for j in range(inertia_address.shape[0]):
        address = inertia_address[wp.max(i, j), wp.min(i, j)]
        if address >= 0:
            product += inertia_in[worldid, address] * qacc_in[worldid, j]
    tau = smooth_in[worldid, i]
    push = constraint_in[worldid, i]
    r = product - tau - push
    wp.atomic_add(gap_out, worldid, r * r)
    wp.atomic_add(size_out, worldid, product * product + tau * tau + push * push)


@wp.kernel
def residual_share(
    # Out:
    gap_out: wp.array[float],
    size_out: wp.array[float],
    worst_out: wp.array[float],
) -> None:
    """Keeps the largest √(gap/size) of each world and clears both for the next step; NaN stays NaN."""
    worldid = wp.tid()
    share = wp.sqrt(gap_out[worldid] / (size_out[worldid] + 1.0e-12))
    if not (share <= worst_out[worldid]):
        worst_out[worldid] = share
    gap_out[worldid] = 0.0
    size_out[worldid] = 0.0


class ResidualGauge:
    """Largest unbalanced share of the forces, |Ma - τ - Jᵀf| / |(Ma, τ, Jᵀf)|, per world since the last read.

    Args:
        inertia_address: place of each entry of M in its sparse layout, shape (nv, nv).
        nworld: number of worlds W.
    """

    def __init__(self, inertia_address: wp.array, nworld: int) -> None:
        self._address = inertia_address
        self._nworld = nworld
        self._gap, self._size, self._worst = (wp.zeros(nworld, dtype=float) for _ in range(3))

    def launch(self, data: Any, qacc: wp.array) -> None:
        """Launch the measurement of the step just made in `data`, at the acceleration that its solver found."""
        wp.launch(
            residual_squares,
            dim=(self._nworld, self._address.shape[0]),
            inputs=[self._address, data.M, qacc, data.qfrc_smooth, data.qfrc_constraint],
            outputs=[self._gap, self._size],
        )
        wp.launch(residual_share, dim=self._nworld, outputs=[self._gap, self._size, self._worst])

    def read(self, tolerance: float) -> dict[str, float]:
        """Largest and mean share over worlds, and the share of worlds past `tolerance` (solver_unconverged)."""
        worst = np.array(self._worst.numpy())  # a copy: on CPU, numpy() is a view
        self._worst.zero_()
        return {
            "solver_residual_max": float(np.max(worst)),
            "solver_residual_mean": float(np.mean(worst)),
            "solver_unconverged_share": float(np.mean(~(worst <= tolerance))),
        }
