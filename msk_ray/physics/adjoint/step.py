"""`StepAdjoint`: the exact vector-Jacobian product of one `mujoco_warp.step`, as a fixed sequence of launches.

The implicit function theorem at the solver's optimum a (B: damping the integrator treats implicitly, S: minus the
slope of the constraint forces):

    (M + hB) μ = h v̄' ,  (M + JᵀSJ) λ = M μ ,
    Φ(q, v, act, u) = λᵀ(M a - τ) - (Jλ)ᵀ f(J a - aref) - μᵀ(M (a - â) - h B â)   with a, â, λ, μ held fixed,
    gradients of (q, v, act, u)  -=  ∂Φ/∂(q, v, act, u).
"""

from typing import Any

import warp as wp

from msk_ray.physics.adjoint import bodies, integrate, rows, solve
from msk_ray.physics.adjoint.forces import ForcePullbacks
from msk_ray.physics.adjoint.stages import implicit_matrix

_BLOCK = 32


class StepAdjoint(ForcePullbacks):
    """Buffers and launches of one substep's pullback for `nworld` worlds.

    `pull_back` reads a `mujoco_warp.Data` that holds the position and velocity stages of the state before the
    substep (as `mujoco_warp.step` leaves them, except qpos, qvel and act, which must be the state before it) and
    turns the cotangents below from those of the state after the substep into those of the state before.

    Attributes:
        grad_qpos: cotangent of qpos in tangent coordinates, shape (W, nv).
        grad_qvel: shape (W, nv).
        grad_act: shape (W, na).
        grad_ctrl: shape (W, nu); every substep adds to it.
        touch_counter: how many substeps' gradients went through a contact that is approximated.
        live: worlds whose gradient is wanted; the others get exact zeros. Shape (W,), int.
    """

    @property
    def inertia_address(self) -> wp.array:
        """Place of M_ij (j ≤ i) in the sparse inertia, -1 where it is zero; shape (nv, nv)."""
        return self._tables.inertia_address

    def start(self, qpos: wp.array, raw_qpos: wp.array) -> None:
        """Launch the change of a raw cotangent (W, nq) at `qpos` to tangent coordinates, and find the live worlds.

        The cotangents of qvel and act must be in place.
        """
        m = self.model
        wp.launch(
            integrate.project,
            dim=(self.nworld, m.njnt),
            inputs=[m.jnt_type, m.jnt_qposadr, m.jnt_dofadr, qpos, raw_qpos],
            outputs=[self.grad_qpos],
        )
        wp.launch(
            integrate.mark_live,
            dim=self.nworld,
            inputs=[raw_qpos, self.grad_qvel, self.grad_act],
            outputs=[self.live],
        )
        self.grad_ctrl.zero_()
        self.touch_counter.start()

    def finish(self, qpos: wp.array, raw_qpos: wp.array) -> None:
        """Launch the change of the tangent gradient at `qpos` to raw coordinates (W, nq)."""
        m = self.model
        wp.launch(
            integrate.lift,
            dim=(self.nworld, m.njnt),
            inputs=[m.jnt_type, m.jnt_qposadr, m.jnt_dofadr, qpos, self.grad_qpos],
            outputs=[raw_qpos],
        )

    def clip(self, bound: float, clipped: wp.array) -> None:
        """Launch the bound on each world's state cotangent; `clipped` (W,) counts where it acted."""
        wp.launch(
            integrate.clip_norm,
            dim=self.nworld,
            inputs=[bound],
            outputs=[self.grad_qpos, self.grad_qvel, self.grad_act, clipped],
        )

    def pull_back(self, data: Any, qvel_next: wp.array) -> None:
        """Launch the pullback of one substep; `qvel_next` (W, nv) is the velocity after it."""
        self.touch_counter.substep += 1
        self._pull_integrator(data, qvel_next)
        jacobian = self._constraint_laws(data)
        self._solve(data, jacobian)
        self._fields(data)
        if self.mjm.ntendon:
            self._start_tendons(data)
        self._pull_rows(data, jacobian)
        self._pull_contacts(data)
        if self._has_actuators:
            self._pull_actuators(data)
            self._pull_transmissions(data)
        if self._tables.has_turning_spring:
            self._pull_turning_springs(data)
        if self.mjm.ntendon:
            self._pull_tendons(data)
        self._sweep(data)

    def _pull_integrator(self, d: Any, qvel_next: wp.array) -> None:
        m = self.model
        wp.launch(
            integrate.pull_position,
            dim=(self.nworld, m.njnt),
            inputs=[
                m.opt.timestep,
                m.jnt_type,
                m.jnt_dofadr,
                m.jnt_actuatorid,
                m.dof_jntid,
                m.dof_damping,
                m.dof_dampingpoly,
                m.actuator_trntype,
                m.actuator_trnid,
                m.actuator_damping,
                m.actuator_dampingpoly,
                m.actuator_gear,
                self._euler_damping,
                d.qvel,
                qvel_next,
            ],
            outputs=[
                self._damping,
                self._damping_step,
                self.grad_qpos,
                self.grad_qvel,
                self._rhs,
                self._phi_qpos,
                self._phi_qvel,
            ],
        )

    def _constraint_laws(self, d: Any) -> wp.array:
        """The constraint Jacobian as (W, njmax, nv or more), after launching what depends on a alone."""
        m = self.model
        jacobian = d.efc.J
        if self._dense is not None:
            jacobian = self._dense
            wp.launch(
                rows.densify_rows,
                dim=(self.nworld, self._njmax),
                inputs=[d.nefc, d.efc.J_rownnz, d.efc.J_rowadr, d.efc.J_colind, d.efc.J],
                outputs=[jacobian],
            )
        wp.launch(
            rows.row_laws,
            dim=(self.nworld, self._njmax),
            inputs=[
                m.nv,
                d.nefc,
                d.efc.type,
                jacobian,
                d.efc.D,
                d.efc.aref,
                d.efc.frictionloss,
                d.qacc,
            ],
            outputs=[self._jar, self._force, self._slope],
        )
        if self._elliptic:
            wp.launch(
                rows.scaled_jacobian,
                dim=(self.nworld, self._njmax, m.nv),
                inputs=[
                    m.opt.impratio_invsqrt,
                    d.nefc,
                    d.efc.type,
                    d.efc.id,
                    jacobian,
                    d.efc.D,
                    self._jar,
                    self._slope,
                    d.contact.dim,
                    d.contact.friction,
                    d.contact.efc_address,
                ],
                outputs=[self._scaled],
            )
        return jacobian

    def _solve(self, d: Any, jacobian: wp.array) -> None:
        m = self.model
        if self._implicit_all:
            implicit_matrix(m, d, self._step)
        wp.launch(
            solve.build_matrices,
            dim=(self.nworld, m.nv, m.nv),
            inputs=[
                self._elliptic,
                self._tables.inertia_address,
                d.nefc,
                d.M,
                self._step if self._implicit_all else self._damping_step,
                self._implicit_all,
                jacobian,
                self._slope,
                self._scaled,
            ],
            outputs=[self._implicit, self._hessian],
        )
        if self._implicit_all:
            self._solve_implicit(d)
            return
        inputs = [self._implicit, self._hessian, self._rhs, self._damping_step, d.qacc]
        outputs = [self._mu, self._excess, self._lam]
        if m.nv <= solve.TILE_LIMIT:
            kernel = solve.solve_tiled(m.nv)
            wp.launch_tiled(kernel, dim=self.nworld, inputs=inputs, outputs=outputs, block_dim=_BLOCK)
        else:
            wp.launch(solve.solve_serial, dim=self.nworld, inputs=[m.nv, *inputs], outputs=outputs)

    def _solve_implicit(self, d: Any) -> None:
        """μ, a - â and λ where B is a matrix: (M + hB)(a - â) = hB a ,  H λ = h v̄' - hB μ."""
        m = self.model
        address = self._tables.inertia_address

        def product(x: wp.array, scale: float) -> None:
            wp.launch(
                solve.damping_product,
                dim=(self.nworld, m.nv),
                inputs=[address, d.M, self._step, x, self._rhs, scale],
                outputs=[self._push],
            )

        def solve_two(matrix: wp.array, first: wp.array, second: wp.array, outputs: list[wp.array]) -> None:
            inputs = [matrix, first, second]
            if m.nv <= solve.TILE_LIMIT:
                kernel = solve.solve_two_tiled(m.nv)
                wp.launch_tiled(kernel, dim=self.nworld, inputs=inputs, outputs=outputs, block_dim=_BLOCK)
            else:
                wp.launch(solve.solve_two_serial, dim=self.nworld, inputs=[m.nv, *inputs], outputs=outputs)

        product(d.qacc, 1.0)
        solve_two(self._implicit, self._rhs, self._push, [self._mu, self._excess])
        product(self._mu, -1.0)
        solve_two(self._hessian, self._push, self._push, [self._lam, self._push])

    def _fields(self, d: Any) -> None:
        m = self.model
        wp.launch(
            bodies.body_fields,
            dim=(self.nworld, m.nbody),
            inputs=[
                m.opt.gravity,
                self._gravity_on,
                self._tables.body_lastdof,
                m.body_rootid,
                m.body_mass,
                m.body_gravcomp,
                m.dof_parentid,
                d.xipos,
                d.subtree_com,
                d.cdof,
                d.cdof_dot,
                d.cvel,
                d.cinert,
                d.qvel,
                d.qacc,
                self._lam,
                self._mu,
                self._excess,
            ],
            outputs=[
                self._lam_field,
                self._qacc_field,
                self._cacc,
                self._mu_field,
                self._excess_field,
                self._lam_bar,
                self._qvel_bar,
                self._cacc_bar,
                self._qacc_bar,
                self._mu_bar,
                self._excess_bar,
                self._moved_bar,
            ],
        )

    def _sweep(self, d: Any) -> None:
        m = self.model
        t = self._tables
        wp.launch(
            bodies.close_velocity,
            dim=(self.nworld, m.nbody),
            inputs=[t.body_subtree_end, m.body_dofadr, m.body_dofnum, d.cdof, d.qvel, self._cacc_bar],
            outputs=[self._cacc_sum, self._qvel_bar],
        )
        wp.launch(
            bodies.sweep_up,
            dim=(self.nworld, m.nv),
            inputs=[
                t.body_subtree_end,
                m.body_parentid,
                m.body_dofadr,
                m.dof_bodyid,
                t.dof_first,
                t.dof_last,
                t.dof_spring_qpos,
                m.dof_jntid,
                m.jnt_stiffness,
                m.jnt_stiffnesspoly,
                m.qpos_spring,
                bool(self._damper_on),
                self._euler_damping or self._implicit_all,
                m.opt.timestep,
                self.live,
                d.qpos,
                d.qvel,
                d.qacc,
                self._lam,
                self._mu,
                self._excess,
                self._damping,
                d.cdof,
                d.cdof_dot,
                d.cvel,
                self._lam_field,
                self._qacc_field,
                self._cacc,
                self._mu_field,
                self._excess_field,
                self._lam_bar,
                self._qvel_bar,
                self._cacc_sum,
                self._qacc_bar,
                self._mu_bar,
                self._excess_bar,
                self._moved_bar,
                self._phi_qpos,
                self._phi_qvel,
            ],
            outputs=[self.grad_qpos, self.grad_qvel],
        )
