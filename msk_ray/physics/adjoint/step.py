"""`StepAdjoint`: the exact vector-Jacobian product of one `mujoco_warp.step`, as a fixed sequence of launches.

The implicit function theorem at the solver's optimum a (B: damping the integrator treats implicitly, S: minus the
slope of the constraint forces):

    (M + hB) μ = h v̄' ,  (M + JᵀSJ) λ = M μ ,
    Φ(q, v, act, u) = λᵀ(M a - τ) - (Jλ)ᵀ f(J a - aref) - μᵀ(M (a - â) - h B â)   with a, â, λ, μ held fixed,
    gradients of (q, v, act, u)  -=  ∂Φ/∂(q, v, act, u).
"""

from typing import Any

import mujoco
import warp as wp

from msk_ray.physics.adjoint import actuation, bodies, contacts, integrate, rows, scalar_rows, solve
from msk_ray.physics.adjoint.tables import build_tables

_BLOCK = 32


class StepAdjoint:
    """Buffers and launches of one substep's pullback for `nworld` worlds.

    `pull_back` reads a `mujoco_warp.Data` that holds the position and velocity stages of the state before the
    substep (as `mujoco_warp.step` leaves them, except qpos, qvel and act, which must be the state before it) and
    turns the cotangents below from those of the state after the substep into those of the state before.

    Attributes:
        grad_qpos: cotangent of qpos in tangent coordinates, shape (W, nv).
        grad_qvel: shape (W, nv).
        grad_act: shape (W, na).
        grad_ctrl: shape (W, nu); every substep adds to it.
        live: worlds whose gradient is wanted; the others get exact zeros. Shape (W,), int.
    """

    def __init__(self, mjm: mujoco.MjModel, model: Any, data: Any) -> None:
        self.mjm = mjm
        self.model = model
        self.device = data.qpos.device
        worlds, nv, nbody = data.nworld, mjm.nv, mjm.nbody
        self.nworld = worlds
        self._njmax = data.efc.D.shape[1]
        disabled = mjm.opt.disableflags
        bit = mujoco.mjtDisableBit
        self._gravity_on = not disabled & bit.mjDSBL_GRAVITY
        self._damper_on = not disabled & bit.mjDSBL_DAMPER
        self._euler_damping = bool(
            mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
            and not disabled & (bit.mjDSBL_EULERDAMP | bit.mjDSBL_DAMPER)
        )
        self._elliptic = mjm.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
        self._has_actuators = mjm.nu > 0 and not disabled & bit.mjDSBL_ACTUATION

        def floats(*shape: int) -> wp.array:
            return wp.zeros(shape, dtype=float)

        def spatials() -> wp.array:
            return wp.zeros((worlds, nbody), dtype=wp.spatial_vector)

        with wp.ScopedDevice(self.device):
            self._tables = build_tables(mjm, model)
            self.live = wp.ones(worlds, dtype=int)
            self.grad_qpos, self.grad_qvel = floats(worlds, nv), floats(worlds, nv)
            self.grad_act, self.grad_ctrl = floats(worlds, mjm.na), floats(worlds, mjm.nu)
            self._rhs, self._step = floats(worlds, nv), floats(worlds, nv)
            self._damping = wp.zeros((worlds, nv), dtype=wp.vec3)
            self._phi_qpos, self._phi_qvel = floats(worlds, nv), floats(worlds, nv)
            self._mu, self._excess, self._lam = floats(worlds, nv), floats(worlds, nv), floats(worlds, nv)
            self._implicit, self._hessian = floats(worlds, nv, nv), floats(worlds, nv, nv)
            self._jar = floats(worlds, self._njmax)
            self._force, self._slope = floats(worlds, self._njmax), floats(worlds, self._njmax)
            self._scaled = floats(worlds, self._njmax, nv) if self._elliptic else floats(1, 1, 1)
            self._dense = floats(worlds, self._njmax, nv) if model.is_sparse else None
            self._lam_field, self._qacc_field, self._cacc = spatials(), spatials(), spatials()
            self._mu_field, self._excess_field = spatials(), spatials()
            self._lam_bar, self._qvel_bar, self._cacc_bar = spatials(), spatials(), spatials()
            self._qacc_bar, self._moved_bar, self._cacc_sum = spatials(), spatials(), spatials()
            self._rate_bar, self._velocity_bar = floats(worlds, mjm.nu), floats(worlds, mjm.nu)
            ncon = data.naconmax
            self._phi_dist = floats(ncon)
            self._phi_pos = wp.zeros(ncon, dtype=wp.vec3)
            self._phi_frame = wp.zeros(ncon, dtype=wp.mat33)

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
        self._pull_integrator(data, qvel_next)
        jacobian = self._constraint_laws(data)
        self._solve(data, jacobian)
        self._fields(data)
        self._pull_rows(data, jacobian)
        self._pull_contacts(data)
        if self._has_actuators:
            self._pull_actuators(data)
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
                self._step,
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
        wp.launch(
            solve.build_matrices,
            dim=(self.nworld, m.nv, m.nv),
            inputs=[
                self._elliptic,
                self._tables.inertia_address,
                d.nefc,
                d.M,
                self._step,
                False,
                jacobian,
                self._slope,
                self._scaled,
            ],
            outputs=[self._implicit, self._hessian],
        )
        inputs = [self._implicit, self._hessian, self._rhs, self._step, d.qacc]
        outputs = [self._mu, self._excess, self._lam]
        if m.nv <= solve.TILE_LIMIT:
            kernel = solve.solve_tiled(m.nv)
            wp.launch_tiled(kernel, dim=self.nworld, inputs=inputs, outputs=outputs, block_dim=_BLOCK)
        else:
            wp.launch(solve.solve_serial, dim=self.nworld, inputs=[m.nv, *inputs], outputs=outputs)

    def _fields(self, d: Any) -> None:
        m = self.model
        wp.launch(
            bodies.body_fields,
            dim=(self.nworld, m.nbody),
            inputs=[
                m.opt.gravity,
                self._gravity_on,
                self._tables.body_lastdof,
                m.dof_parentid,
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
                self._moved_bar,
            ],
        )

    def _pull_rows(self, d: Any, jacobian: wp.array) -> None:
        m = self.model
        if m.jnt_limited_slide_hinge_adr.size:
            wp.launch(
                scalar_rows.pull_limits,
                dim=(self.nworld, self._njmax),
                inputs=[
                    m.opt.timestep,
                    m.opt.disableflags,
                    m.jnt_dofadr,
                    m.jnt_solref,
                    m.jnt_solimp,
                    d.nefc,
                    d.efc.type,
                    d.efc.id,
                    jacobian,
                    d.efc.pos,
                    d.efc.margin,
                    self._force,
                    self._slope,
                    self._lam,
                ],
                outputs=[self._phi_qpos, self._phi_qvel],
            )

    def _pull_contacts(self, d: Any) -> None:
        m = self.model
        wp.launch(
            contacts.pull_contacts,
            dim=d.naconmax,
            inputs=[
                m.opt.timestep,
                m.opt.disableflags,
                m.opt.impratio_invsqrt,
                m.body_rootid,
                m.geom_bodyid,
                d.nacon,
                d.efc.type,
                d.efc.D,
                self._jar,
                self._force,
                self._slope,
                d.contact.dist,
                d.contact.pos,
                d.contact.frame,
                d.contact.includemargin,
                d.contact.friction,
                d.contact.solref,
                d.contact.solreffriction,
                d.contact.solimp,
                d.contact.dim,
                d.contact.geom,
                d.contact.efc_address,
                d.contact.worldid,
                d.subtree_com,
                self._lam_field,
                self._qacc_field,
                d.cvel,
            ],
            outputs=[
                self._lam_bar,
                self._qacc_bar,
                self._qvel_bar,
                self._moved_bar,
                self._phi_dist,
                self._phi_pos,
                self._phi_frame,
            ],
        )
        wp.launch(
            contacts.pull_geometry,
            dim=d.naconmax,
            inputs=[
                m.body_rootid,
                m.geom_bodyid,
                m.geom_type,
                m.geom_size,
                d.nacon,
                d.contact.dist,
                d.contact.pos,
                d.contact.frame,
                d.contact.geom,
                d.contact.efc_address,
                d.contact.worldid,
                d.geom_xpos,
                d.geom_xmat,
                d.subtree_com,
                self._phi_dist,
                self._phi_pos,
                self._phi_frame,
            ],
            outputs=[self._moved_bar],
        )

    def _pull_actuators(self, d: Any) -> None:
        m = self.model
        clampctrl = not self.mjm.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
        wp.launch(
            actuation.pull_actuators,
            dim=(self.nworld, m.nactuator),
            inputs=[
                m.opt.timestep,
                clampctrl,
                m.jnt_actfrclimited,
                m.jnt_actfrcrange,
                m.dof_jntid,
                m.actuator_dyntype,
                m.actuator_gaintype,
                m.actuator_biastype,
                m.actuator_ctrladr,
                m.actuator_ctrlnum,
                m.actuator_actadr,
                m.actuator_actnum,
                m.actuator_dynprm,
                m.actuator_gainprm,
                m.actuator_biasprm,
                m.actuator_actlimited,
                m.actuator_actrange,
                m.actuator_actearly,
                m.actuator_forcelimited,
                m.actuator_forcerange,
                m.actuator_ctrllimited,
                m.actuator_ctrlrange,
                m.actuator_acc0,
                m.actuator_lengthrange,
                self.live,
                d.ctrl,
                d.act,
                d.qvel,
                d.actuator_length,
                d.moment_rownnz,
                d.moment_rowadr,
                d.moment_colind,
                d.actuator_moment,
                d.qfrc_actuator,
                self._lam,
            ],
            outputs=[
                self.grad_act,
                self.grad_ctrl,
                self._phi_qpos,
                self._phi_qvel,
                self._rate_bar,
                self._velocity_bar,
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
                self._euler_damping,
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
                d.cinert,
                self._lam_field,
                self._qacc_field,
                self._cacc,
                self._mu_field,
                self._excess_field,
                self._lam_bar,
                self._qvel_bar,
                self._cacc_sum,
                self._qacc_bar,
                self._moved_bar,
                self._phi_qpos,
                self._phi_qvel,
            ],
            outputs=[self.grad_qpos, self.grad_qvel],
        )
