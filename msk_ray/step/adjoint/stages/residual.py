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
    M_in: wp.array2d[float],
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
            product += M_in[worldid, address] * qacc_in[worldid, j]
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
    tolerance: float,
    # Out:
    worst_out: wp.array[float],
    unconverged_out: wp.array[wp.int64],
) -> None:
    """Keeps the largest √(gap/size) of each world, both added up over its dofs, and counts those that are above
    `tolerance`; NaN stays NaN and is not counted, because a world that has diverged is no matter of the solver."""
    worldid = wp.tid()
    gap = float(0.0)
    size = float(0.0)
    for i in range(gap_in.shape[1]):
        gap += gap_in[worldid, i]
        size += size_in[worldid, i]
    share = wp.sqrt(gap / (size + 1.0e-12))
    if share > tolerance:
        wp.atomic_add(unconverged_out, 0, wp.int64(1))
    if not (share <= worst_out[worldid]):
        worst_out[worldid] = share


@wp.kernel
def tell_host(
    # In:
    unconverged_in: wp.array[wp.int64],
    made: int,
    # Out:
    made_out: wp.array[wp.int64],
    told_out: wp.array[wp.int64],
) -> None:
    """`made` more substeps; a single thread writes where the host can read (unconverged ones, all)."""
    made_out[0] = made_out[0] + wp.int64(made)
    told_out[0] = unconverged_in[0]
    told_out[1] = made_out[0]


class ResidualGauge:
    """Largest unbalanced share of the forces, |Ma - τ - Jᵀf| / |(Ma, τ, Jᵀf)|, per world since the last read, and the
    share of the substeps of all worlds in which the solver left more than `tolerance`.

    On CUDA that share is written to memory of the host, so that asking for it waits for nothing.

    Args:
        inertia_address: place of each entry of M in its sparse layout, shape (nv, nv).
        nworld: number of worlds W.
        tolerance: share of the forces above which a solver has not converged.
    """

    def __init__(self, inertia_address: wp.array, nworld: int, tolerance: float) -> None:
        self._address = inertia_address
        self._nworld = nworld
        self._tolerance = tolerance
        shape = (nworld, inertia_address.shape[0])
        self._gap, self._size = (wp.zeros(shape, dtype=float) for _ in range(2))
        self._worst = wp.zeros(nworld, dtype=float)
        self._unconverged, self._made = (wp.zeros(1, dtype=wp.int64) for _ in range(2))
        device = self._worst.device
        # Pinned memory has one address for host and device.
        self._host = wp.zeros(2, dtype=wp.int64, device="cpu", pinned=device.is_cuda)
        self._told = wp.array(ptr=self._host.ptr, dtype=wp.int64, shape=(2,), device=device, copy=False)
        self._told_view = self._host.numpy()

    def launch(self, data: Any, qacc: wp.array) -> None:
        """Launch the measurement of the step just made in `data`, at the acceleration that its solver found."""
        wp.launch(
            residual_squares,
            dim=(self._nworld, self._address.shape[0]),
            inputs=[self._address, data.M, qacc, data.qfrc_smooth, data.qfrc_constraint],
            outputs=[self._gap, self._size],
        )
        wp.launch(
            residual_share,
            dim=self._nworld,
            inputs=[self._gap, self._size, self._tolerance],
            outputs=[self._worst, self._unconverged],
        )

    def launch_end(self, substeps: int) -> None:
        """Launch the end of an env step of so many substeps, each of which has been measured."""
        wp.launch(
            tell_host, dim=1, inputs=[self._unconverged, substeps * self._nworld], outputs=[self._made, self._told]
        )

    def unconverged(self) -> float:
        """Share of the substeps since the last read, up to an env step that the device has finished; waits for none."""
        unconverged, made = (int(n) for n in self._told_view)
        return unconverged / made if made else 0.0

    def read(self) -> dict[str, float]:
        """Largest and mean residual over worlds, the share of worlds that were unconverged in any substep, and the
        share of the substeps of all worlds that were. Waits for the steps, and forgets what it returns."""
        worst = np.array(self._worst.numpy())  # a copy: on CPU, numpy() is a view
        figures = {
            "solver_residual_max": float(np.max(worst)),
            "solver_residual_mean": float(np.mean(worst)),
            "solver_unconverged_share": float(np.mean(~(worst <= self._tolerance))),
            "solver_unconverged_substeps": self.unconverged(),
        }
        self.clear()
        return figures

    def clear(self) -> None:
        """Forget what was measured."""
        for array in (self._worst, self._unconverged, self._made, self._host):
            array.zero_()
