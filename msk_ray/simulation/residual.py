"""How far from its optimum the solver stopped: the adjoint's formula holds at the optimum only."""

from typing import Any

import numpy as np
import warp as wp

from msk_ray.physics.adjoint.residual import residual_share, residual_squares


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

    def launch(self, data: Any) -> None:
        """Launch the measurement of the step just made in `data`."""
        wp.launch(
            residual_squares,
            dim=(self._nworld, self._address.shape[0]),
            inputs=[self._address, data.M, data.qacc, data.qfrc_smooth, data.qfrc_constraint],
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
