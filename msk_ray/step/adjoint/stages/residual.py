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
    gap_out: wp.array2d[float],
    size_out: wp.array2d[float],
) -> None:
    """Every dof's (Ma - τ - Jᵀf)², and (Ma)² + τ² + (Jᵀf)²."""
    worldid, i = wp.tid()
    product = float(0.0)
    for j in range(inertia_address.shape[0]):
        address = inertia_address[wp.max(i, j), wp.min(i, j)]
        if address >= 0:
            product += inertia_in[worldid, address] * qacc_in[worldid, j]
    tau = smooth_in[worldid, i]
    push = constraint_in[worldid, i]
    r = product - tau - push
    gap_out[worldid, i] = r * r
    size_out[worldid, i] = product * product + tau * tau + push * push


@wp.kernel
def residual_share(
    # In:
    gap_in: wp.array2d[float],
    size_in: wp.array2d[float],
    # Out:
    worst_out: wp.array[float],
) -> None:
    """Keeps the largest √(gap/size) of each world, both added up over its dofs; NaN stays NaN."""
    worldid = wp.tid()
    gap = float(0.0)
    size = float(0.0)
    for i in range(gap_in.shape[1]):
        gap += gap_in[worldid, i]
        size += size_in[worldid, i]
    share = wp.sqrt(gap / (size + 1.0e-12))
    if not (share <= worst_out[worldid]):
        worst_out[worldid] = share


class ResidualGauge:
    """Largest unbalanced share of the forces, |Ma - τ - Jᵀf| / |(Ma, τ, Jᵀf)|, per world since the last read.

    Args:
        inertia_address: place of each entry of M in its sparse layout, shape (nv, nv).
        nworld: number of worlds W.
    """

    def __init__(self, inertia_address: wp.array, nworld: int) -> None:
        self._address = inertia_address
        self._nworld = nworld
        shape = (nworld, inertia_address.shape[0])
        self._gap, self._size = (wp.zeros(shape, dtype=float) for _ in range(2))
        self._worst = wp.zeros(nworld, dtype=float)

    def launch(self, data: Any, qacc: wp.array) -> None:
        """Launch the measurement of the step just made in `data`, at the acceleration that its solver found."""
        wp.launch(
            residual_squares,
            dim=(self._nworld, self._address.shape[0]),
            inputs=[self._address, data.M, qacc, data.qfrc_smooth, data.qfrc_constraint],
            outputs=[self._gap, self._size],
        )
        wp.launch(residual_share, dim=self._nworld, inputs=[self._gap, self._size], outputs=[self._worst])

    def read(self, tolerance: float) -> dict[str, float]:
        """Largest and mean share over worlds, and the share of worlds past `tolerance` (solver_unconverged)."""
        worst = np.array(self._worst.numpy())  # a copy: on CPU, numpy() is a view
        self._worst.zero_()
        return {
            "solver_residual_max": float(np.max(worst)),
            "solver_residual_mean": float(np.mean(worst)),
            "solver_unconverged_share": float(np.mean(~(worst <= tolerance))),
        }
