"""Forces from outside: qfrc_applied on dofs, xfrc_applied at the centres of mass of bodies, both fixed in the world.

With u the velocity of a body's centre of mass under λ and ω its angular velocity,

    Φ ∋ -λᵀ qfrc - Σ_b (u_b·F_b + ω_b·T_b)   ⇒   q̄frc += λ ,  F̄_b += u_b ,  T̄_b += ω_b .
"""

from typing import Any

import warp as wp

from msk_ray.step.adjoint.groups import FieldBars, Fields, Motion, Multipliers, Substep
from msk_ray.step.adjoint.spatial import point_velocity, wrench
from msk_ray.step.adjoint.workspace import Workspace

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pull_applied_dofs(
    # In:
    live_in: wp.array[int],
    multipliers_in: Multipliers,
    # Out:
    qfrc_out: wp.array2d[float],
) -> None:
    """q̄frc += λ."""
    worldid, dof = wp.tid()
    if live_in[worldid] != 0:
        qfrc_out[worldid, dof] += multipliers_in.lam[worldid, dof]


@wp.kernel
def pull_applied_bodies(
    # Model:
    body_rootid: wp.array[int],
    # In:
    live_in: wp.array[int],
    xfrc_applied_in: wp.array2d[wp.spatial_vector],
    motion_in: Motion,
    fields_in: Fields,
    # Out:
    bars_out: FieldBars,
    xfrc_out: wp.array2d[wp.spatial_vector],
) -> None:
    """(F̄, T̄) += (u, ω), and what the forces add to the cotangents of twists and displacements."""
    worldid, body = wp.tid()
    lam = fields_in.lam[worldid, body]
    arm = motion_in.xipos[worldid, body] - motion_in.subtree_com[worldid, body_rootid[body]]
    u = point_velocity(lam, arm)
    omega = wp.spatial_top(lam)
    if live_in[worldid] != 0:
        xfrc_out[worldid, body] += wp.spatial_vector(u, omega)
    force = wp.spatial_top(xfrc_applied_in[worldid, body])
    torque = wp.spatial_bottom(xfrc_applied_in[worldid, body])
    bars_out.lam[worldid, body] = bars_out.lam[worldid, body] - wrench(force, torque, arm)
    # Seen from the body, a force fixed in the world turns back: δΦ = w·(F × u + T × ω) for a rotation w.
    turned = wp.cross(force, u) + wp.cross(torque, omega)
    bars_out.moved[worldid, body] = bars_out.moved[worldid, body] + wp.spatial_vector(turned, wp.vec3(0.0))


class AppliedForces:
    """Launches of the gradients of applied forces.

    Attributes:
        grad_qfrc: cotangent of qfrc_applied, shape (W, nv); every substep adds to it.
        grad_xfrc: cotangent of xfrc_applied, force before torque, shape (W, B), spatial_vector.
    """

    def __init__(self, work: Workspace) -> None:
        self._work = work
        self.grad_qfrc: Any = wp.zeros((work.nworld, work.mjm.nv), dtype=float)
        self.grad_xfrc: Any = wp.zeros((work.nworld, work.mjm.nbody), dtype=wp.spatial_vector)

    def start(self) -> None:
        """Launch the beginning of an env step's pullback."""
        self.grad_qfrc.zero_()
        self.grad_xfrc.zero_()

    def launch(self, at: Substep) -> None:
        """Launch its kernels at one substep."""
        work = self._work
        work.launch(pull_applied_dofs, self.grad_qfrc.shape, at, qfrc=self.grad_qfrc)
        work.launch(pull_applied_bodies, self.grad_xfrc.shape, at, xfrc=self.grad_xfrc)
