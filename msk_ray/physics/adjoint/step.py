"""`StepAdjoint`: the exact vector-Jacobian product of one `mujoco_warp.step`, as a fixed sequence of launches.

The implicit function theorem at the solver's optimum a (B: damping the integrator treats implicitly, S: minus the
slope of the constraint forces):

    (M + hB) μ = h v̄' ,  (M + JᵀSJ) λ = M μ ,
    Φ(q, v, act, u) = λᵀ(M a - τ) - (Jλ)ᵀ f(J a - aref) - μᵀ(M (a - â) - h B â)   with a, â, λ, μ held fixed,
    gradients of (q, v, act, u)  -=  ∂Φ/∂(q, v, act, u).
"""

from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco_warp._src.types import MJ_MAXVAL

from msk_ray.physics.adjoint import (
    actuation,
    bodies,
    contacts,
    equality,
    geometry,
    integrate,
    joints,
    rows,
    scalar_rows,
    solve,
    tendons,
    transmission,
    wrapping,
)
from msk_ray.physics.adjoint.coverage import colliding_pairs
from msk_ray.physics.adjoint.stages import implicit_matrix
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
        self._implicit_all = mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self._spring_on = not disabled & bit.mjDSBL_SPRING
        self._has_connects = bool(np.any(mjm.eq_type == int(mujoco.mjtEq.mjEQ_CONNECT)))
        types = {(int(mjm.geom_type[a]), int(mjm.geom_type[b])) for a, b in colliding_pairs(mjm)}
        self._scored_pairs = bool(types & geometry.SCORED_PAIRS)
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
            self._rhs, self._damping_step = floats(worlds, nv), floats(worlds, nv)
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
            self._mu_bar, self._excess_bar = spatials(), spatials()
            self._length_bar = floats(worlds, model.nactuator)
            self._rate_bar = wp.zeros((worlds, model.nactuator), dtype=wp.vec4)
            count = max(mjm.ntendon, 1)
            segments = max(self._tables.segment_tendon.size, 1)
            self._touch = wp.full((worlds, segments), wp.spatial_vector(*([MJ_MAXVAL] * 6)), dtype=wp.spatial_vector)
            self._ten_length_bar, self._ten_qvel_bar = floats(worlds, count), floats(worlds, count)
            self._ten_lam_bar, self._ten_qacc_bar = floats(worlds, count), floats(worlds, count)
            self._ten_mu_bar, self._ten_smooth_bar = floats(worlds, count), floats(worlds, count)
            if self._implicit_all:
                self._step = floats(worlds, model.nC)
                self._push = floats(worlds, nv)
            ncon = data.naconmax
            self._phi_dist = floats(ncon)
            self._phi_pos = wp.zeros(ncon, dtype=wp.vec3)
            self._phi_frame = wp.zeros(ncon, dtype=wp.mat33)

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
        solve_two(self._hessian, self._push, self._push, [self._lam, self._lam])

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

    def _pull_rows(self, d: Any, jacobian: wp.array) -> None:
        m = self.model
        if self._has_connects:
            wp.launch(
                equality.pull_connects,
                dim=(self.nworld, self._njmax),
                inputs=[
                    m.opt.timestep,
                    m.opt.disableflags,
                    m.body_rootid,
                    m.site_bodyid,
                    m.eq_type,
                    m.eq_objtype,
                    m.eq_obj1id,
                    m.eq_obj2id,
                    m.eq_solref,
                    m.eq_solimp,
                    m.eq_data,
                    d.nefc,
                    d.efc.type,
                    d.efc.id,
                    self._slope,
                    self._force,
                    d.xpos,
                    d.xmat,
                    d.site_xpos,
                    d.subtree_com,
                    self._lam_field,
                    d.cvel,
                    self._cacc,
                ],
                outputs=[self._lam_bar, self._qvel_bar, self._cacc_bar, self._moved_bar],
            )
        if not self._tables.has_scalar_rows:
            return
        wp.launch(
            scalar_rows.pull_rows,
            dim=(self.nworld, self._njmax),
            inputs=[
                m.opt.timestep,
                m.opt.disableflags,
                m.qpos0,
                m.jnt_type,
                m.jnt_qposadr,
                m.jnt_dofadr,
                m.jnt_solref,
                m.jnt_solimp,
                m.dof_solref,
                m.dof_solimp,
                m.ten_J_rownnz,
                m.ten_J_rowadr,
                m.ten_J_colind,
                m.tendon_solref_lim,
                m.tendon_solimp_lim,
                m.tendon_solref_fri,
                m.tendon_solimp_fri,
                m.tendon_range,
                m.tendon_length0,
                m.eq_type,
                m.eq_obj1id,
                m.eq_obj2id,
                m.eq_solref,
                m.eq_solimp,
                m.eq_data,
                d.nefc,
                d.efc.type,
                d.efc.id,
                jacobian,
                d.efc.pos,
                d.efc.margin,
                self._force,
                self._slope,
                d.qpos,
                d.qvel,
                d.qacc,
                self._lam,
                d.ten_J,
                d.ten_length,
            ],
            outputs=[
                self._phi_qpos,
                self._phi_qvel,
                self._ten_length_bar,
                self._ten_qvel_bar,
                self._ten_lam_bar,
                self._ten_qacc_bar,
            ],
        )

    def _start_tendons(self, d: Any) -> None:
        m = self.model
        wp.launch(
            tendons.start_tendons,
            dim=(self.nworld, m.ntendon),
            inputs=[
                m.opt.timestep,
                bool(self._spring_on),
                bool(self._damper_on),
                self._implicit_all,
                m.tendon_actuatorid,
                m.ten_J_rownnz,
                m.ten_J_rowadr,
                m.ten_J_colind,
                m.tendon_stiffness,
                m.tendon_stiffnesspoly,
                m.tendon_damping,
                m.tendon_dampingpoly,
                m.tendon_lengthspring,
                m.actuator_trntype,
                m.actuator_trnid,
                m.actuator_damping,
                m.actuator_dampingpoly,
                m.actuator_gear,
                self._tables.inertia_address,
                d.qvel,
                d.qacc,
                d.ten_J,
                d.ten_length,
                self._lam,
                self._mu,
                self._excess,
            ],
            outputs=[
                self._ten_length_bar,
                self._ten_qvel_bar,
                self._ten_lam_bar,
                self._ten_qacc_bar,
                self._ten_mu_bar,
                self._ten_smooth_bar,
            ],
        )

    def _pull_tendons(self, d: Any) -> None:
        m = self.model
        t = self._tables
        wp.launch(
            tendons.pull_tendons,
            dim=(self.nworld, m.ntendon, m.max_ten_J_rownnz),
            inputs=[
                m.ten_J_rownnz,
                m.ten_J_rowadr,
                m.ten_J_colind,
                m.tendon_adr,
                m.wrap_type,
                d.ten_J,
                self._ten_length_bar,
                self._ten_qvel_bar,
            ],
            outputs=[self._phi_qpos, self._phi_qvel],
        )
        if not t.segment_tendon.size:
            return
        if t.has_wrapping:
            wp.launch(
                wrapping.touch_paths,
                dim=(self.nworld, t.segment_tendon.size),
                inputs=[
                    m.geom_size,
                    m.wrap_type,
                    m.wrap_objid,
                    m.wrap_prm,
                    t.segment_first,
                    t.segment_geom,
                    t.segment_last,
                    d.geom_xpos,
                    d.geom_xmat,
                    d.site_xpos,
                ],
                outputs=[self._touch],
            )
        wp.launch(
            tendons.pull_paths,
            dim=(self.nworld, t.segment_tendon.size),
            inputs=[
                m.body_rootid,
                m.geom_bodyid,
                m.geom_size,
                m.site_bodyid,
                m.wrap_type,
                m.wrap_objid,
                m.wrap_prm,
                m.wrap_pulley_scale,
                t.segment_tendon,
                t.segment_first,
                t.segment_geom,
                t.segment_last,
                self._touch,
                d.geom_xpos,
                d.geom_xmat,
                d.site_xpos,
                d.subtree_com,
                self._lam_field,
                self._qacc_field,
                d.cvel,
                self._mu_field,
                self._excess_field,
                self._ten_lam_bar,
                self._ten_qacc_bar,
                self._ten_qvel_bar,
                self._ten_mu_bar,
                self._ten_smooth_bar,
            ],
            outputs=[
                self._lam_bar,
                self._qacc_bar,
                self._qvel_bar,
                self._mu_bar,
                self._excess_bar,
                self._moved_bar,
            ],
        )

    def _pull_turning_springs(self, d: Any) -> None:
        m = self.model
        wp.launch(
            joints.pull_turning_springs,
            dim=(self.nworld, m.njnt),
            inputs=[
                m.qpos_spring,
                m.jnt_type,
                m.jnt_qposadr,
                m.jnt_dofadr,
                m.jnt_stiffness,
                m.jnt_stiffnesspoly,
                d.qpos,
                self._lam,
            ],
            outputs=[self._phi_qpos],
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
            geometry.pull_geometry_kernel(self._scored_pairs),
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
                d.contact.geomcollisionid,
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
                self._implicit_all,
                self._tables.inertia_address,
                m.jnt_type,
                m.jnt_actfrclimited,
                m.jnt_actfrcrange,
                m.dof_jntid,
                m.actuator_trntype,
                m.actuator_trnid,
                m.actuator_gear,
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
                d.qacc,
                self._lam,
                self._mu,
                self._excess,
            ],
            outputs=[
                self.grad_act,
                self.grad_ctrl,
                self._phi_qpos,
                self._phi_qvel,
                self._ten_length_bar,
                self._ten_qvel_bar,
                self._ten_lam_bar,
                self._ten_mu_bar,
                self._ten_smooth_bar,
                self._length_bar,
                self._rate_bar,
            ],
        )

    def _pull_transmissions(self, d: Any) -> None:
        m = self.model
        if self._tables.has_turning_transmission:
            wp.launch(
                transmission.pull_turning_joints,
                dim=(self.nworld, m.nactuator),
                inputs=[
                    m.jnt_type,
                    m.jnt_qposadr,
                    m.jnt_dofadr,
                    m.actuator_trntype,
                    m.actuator_trnid,
                    m.actuator_gear,
                    d.qpos,
                    d.qvel,
                    d.qacc,
                    self._lam,
                    self._mu,
                    self._excess,
                    d.moment_rowadr,
                    d.actuator_moment,
                    self._length_bar,
                    self._rate_bar,
                ],
                outputs=[self._phi_qpos],
            )
        if self._tables.has_site_transmission:
            wp.launch(
                transmission.pull_sites,
                dim=(self.nworld, m.nactuator),
                inputs=[
                    m.body_rootid,
                    m.site_bodyid,
                    m.actuator_trntype,
                    m.actuator_trnid,
                    m.actuator_gear,
                    d.site_xpos,
                    d.site_xmat,
                    d.subtree_com,
                    self._rate_bar,
                    self._lam_field,
                    d.cvel,
                    self._qacc_field,
                    self._mu_field,
                    self._excess_field,
                ],
                outputs=[
                    self._lam_bar,
                    self._qvel_bar,
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
