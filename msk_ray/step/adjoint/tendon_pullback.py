"""Lengths and rates of all tendons as functions of (q, v), and their exact pullback.

With cotangents l̄ and ρ̄ of a tendon's length and rate, Φ = Σ l̄ l + ρ̄ J v has no other fields than v, so the launches
of a substep's adjoint give ∂Φ/∂q and ∂Φ/∂v once λ, μ, a and a - â are zero.
"""

from typing import Any

import mujoco_warp as mjw
import warp as wp

from msk_ray.step.adjoint.groups import Substep, TendonRows
from msk_ray.step.adjoint.laws.bodies import Bodies
from msk_ray.step.adjoint.laws.tendons import Tendons, tendon_rate
from msk_ray.step.adjoint.stages.integrate import Integrator
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.stages import Stages


@wp.kernel(enable_backward=False)
def tendon_rates(
    # Model:
    tendons: TendonRows,
    # In:
    qvel_in: wp.array2d[float],
    ten_J_in: wp.array2d[float],
    # Out:
    rate_out: wp.array2d[float],
) -> None:
    """ρ = J v."""
    worldid, t = wp.tid()
    rate_out[worldid, t] = tendon_rate(tendons, t, ten_J_in[worldid], qvel_in[worldid])


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


class TendonAdjoint:
    """Buffers and launches for `nworld` worlds, on a `mujoco_warp.Data` whose qpos and qvel are set.

    Attributes:
        rate: J v of every tendon [m/s], shape (W, ntendon).
        length_bar, rate_bar: cotangents of length and rate, read by `launch_pullback`, shape (W, ntendon).
        grad_qpos, grad_qvel: what they pull back to, in tangent coordinates, shape (W, nv).
    """

    def __init__(self, mjm: Any, model: Any, data: Any, stages: Stages) -> None:
        self._work = work = Workspace(mjm, model, data, stages)
        with wp.ScopedDevice(work.device):
            self._integrator = Integrator(work)
            self._bodies = Bodies(work)
            self._tendons = Tendons(work)
            shape = (work.nworld, mjm.ntendon)
            self.rate, self.length_bar, self.rate_bar = (wp.zeros(shape, dtype=float) for _ in range(3))
        self.grad_qpos, self.grad_qvel = work.grad_qpos, work.grad_qvel
        self.finish = self._integrator.finish

    def launch_forward(self, data: Any) -> None:
        """Launch lengths, into `data.ten_length`, and rates."""
        m = self._work.model
        mjw.kinematics(m, data)
        mjw.com_pos(m, data)
        self._work.stages.tendon(m, data)
        work = self._work
        work.launch(tendon_rates, self.rate.shape, Substep(data), rate=self.rate)

    def launch_pullback(self, data: Any) -> None:
        """Launch the pullback of `length_bar` and `rate_bar` at the state in `data`."""
        work = self._work
        self.launch_forward(data)
        mjw.com_vel(work.model, data)
        held, slopes = work.multipliers, work.slopes
        for array in (work.grad_qpos, work.grad_qvel, slopes.qpos, slopes.qvel, held.lam, held.mu, held.excess):
            array.zero_()
        data.qacc.zero_()
        at = Substep(data)
        self._bodies.launch_fields(at)
        bars = work.tendon_bars
        for array in (bars.lam, bars.qacc, bars.mu, bars.smooth):
            array.zero_()
        given = {"length_bar": self.length_bar, "rate_bar": self.rate_bar}
        work.launch(negated, self.rate.shape, at, **given, length=bars.length, rate=bars.qvel)
        self._tendons.launch_pullback(at)
        self._bodies.launch_sweep(at)
