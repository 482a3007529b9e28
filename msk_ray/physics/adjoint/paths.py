"""Lengths and rates of all tendons as functions of (q, v), and their exact pullback.

With cotangents l̄ and ρ̄ of a tendon's length and rate, Φ = Σ l̄ l + ρ̄ J v has no other fields than v, so the launches
of a substep's adjoint give ∂Φ/∂q and ∂Φ/∂v once λ, μ, a and a - â are zero.
"""

from typing import Any

import mujoco_warp as mjw
import warp as wp

from msk_ray.physics.adjoint.step import StepAdjoint
from msk_ray.physics.adjoint.tendons import tendon_rate


@wp.kernel(enable_backward=False)
def tendon_rates(
    # Model:
    ten_J_rownnz: wp.array[int],
    ten_J_rowadr: wp.array[int],
    ten_J_colind: wp.array[int],
    # In:
    qvel_in: wp.array2d[float],
    ten_J_in: wp.array2d[float],
    # Out:
    rate_out: wp.array2d[float],
) -> None:
    """ρ = J v."""
    worldid, t = wp.tid()
    rate_out[worldid, t] = tendon_rate(
        ten_J_rownnz[t], ten_J_rowadr[t], ten_J_colind, ten_J_in[worldid], qvel_in[worldid]
    )


@wp.kernel(enable_backward=False)
def negated(
    # In:
    length_bar_in: wp.array2d[float],
    rate_bar_in: wp.array2d[float],
    # Out:
    length_out: wp.array2d[float],
    rate_out: wp.array2d[float],
) -> None:
    """-Φ: the sweep subtracts its slopes."""
    worldid, t = wp.tid()
    length_out[worldid, t] = -length_bar_in[worldid, t]
    rate_out[worldid, t] = -rate_bar_in[worldid, t]


class TendonAdjoint(StepAdjoint):
    """Buffers and launches for `nworld` worlds, on a `mujoco_warp.Data` whose qpos and qvel are set.

    Attributes:
        rate: J v of every tendon [m/s], shape (W, ntendon).
        length_bar, rate_bar: cotangents of length and rate, read by `launch_pullback`, shape (W, ntendon).
        grad_qpos, grad_qvel: what they pull back to, in tangent coordinates, shape (W, nv).
    """

    def __init__(self, mjm: Any, model: Any, data: Any) -> None:
        super().__init__(mjm, model, data)
        with wp.ScopedDevice(self.device):
            shape = (self.nworld, mjm.ntendon)
            self.rate, self.length_bar, self.rate_bar = (wp.zeros(shape, dtype=float) for _ in range(3))

    def launch_forward(self, data: Any) -> None:
        """Launch lengths, into `data.ten_length`, and rates."""
        m = self.model
        mjw.kinematics(m, data)
        mjw.com_pos(m, data)
        mjw.tendon(m, data)
        wp.launch(
            tendon_rates,
            dim=(self.nworld, m.ntendon),
            inputs=[m.ten_J_rownnz, m.ten_J_rowadr, m.ten_J_colind, data.qvel, data.ten_J],
            outputs=[self.rate],
        )

    def launch_pullback(self, data: Any) -> None:
        """Launch the pullback of `length_bar` and `rate_bar` at the state in `data`."""
        self.launch_forward(data)
        mjw.com_vel(self.model, data)
        for array in (
            self.grad_qpos,
            self.grad_qvel,
            self._phi_qpos,
            self._phi_qvel,
            self._lam,
            self._mu,
            self._excess,
        ):
            array.zero_()
        data.qacc.zero_()
        self._fields(data)
        for array in (self._ten_lam_bar, self._ten_qacc_bar, self._ten_mu_bar, self._ten_smooth_bar):
            array.zero_()
        wp.launch(
            negated,
            dim=(self.nworld, self.model.ntendon),
            inputs=[self.length_bar, self.rate_bar],
            outputs=[self._ten_length_bar, self._ten_qvel_bar],
        )
        self._pull_tendons(data)
        self._sweep(data)
