"""How far from its optimum the solver stopped: the adjoint's formula holds at the optimum only."""

from typing import Any

import numpy as np
import warp as wp

from msk_ray.physics.adjoint.residual import residual_share


class ResidualGauge:
    """Largest unbalanced share of the forces, |Ma - τ - Jᵀf| / (|Ma| + |τ| + |Jᵀf|), per world since the last read.

    Args:
        model: mujoco_warp model.
        nworld: number of worlds W.
    """

    def __init__(self, model: Any, nworld: int) -> None:
        self._model = model
        self._nworld = nworld
        self._worst = wp.zeros(nworld, dtype=float)

    def launch(self, data: Any) -> None:
        """Launch the measurement of the step just made in `data`."""
        wp.launch(
            residual_share,
            dim=self._nworld,
            inputs=[
                self._model.nv,
                self._model.M_rownnz,
                self._model.M_rowadr,
                self._model.M_colind,
                data.M,
                data.qacc,
                data.qfrc_smooth,
                data.qfrc_constraint,
                data.efc.Ma,
            ],
            outputs=[self._worst],
        )

    def read(self, tolerance: float) -> dict[str, float]:
        """Largest and mean share over worlds, and the share of worlds past `tolerance` (solver_unconverged)."""
        worst = np.array(self._worst.numpy())  # a copy: on CPU, numpy() is a view
        self._worst.zero_()
        return {
            "solver_residual_max": float(np.max(worst)),
            "solver_residual_mean": float(np.mean(worst)),
            "solver_unconverged_share": float(np.mean(~(worst <= tolerance))),
        }
