"""Buffers and flags of a substep's adjoint: what every launch reads or writes besides mujoco_warp's own arrays."""

from typing import Any

import mujoco
import numpy as np
import warp as wp

from msk_ray.physics.adjoint import geometry
from msk_ray.physics.adjoint.approximated import TouchCounter
from msk_ray.physics.adjoint.coverage import colliding_pairs
from msk_ray.physics.adjoint.tables import build_tables
from msk_ray.physics.mjw_private import MJ_MAXVAL


class StepBuffers:
    """Allocates for `nworld` worlds of one model, and notes which launches the model needs."""

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
        held = [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)]
        self._has_anchors = bool(np.any(np.isin(mjm.eq_type, held)))
        types = {(int(mjm.geom_type[a]), int(mjm.geom_type[b])) for a, b in colliding_pairs(mjm)}
        self._pair_kinds = geometry.PairKinds.of(mjm, types)
        self._elliptic = mjm.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
        self._has_actuators = mjm.nu > 0 and not disabled & bit.mjDSBL_ACTUATION

        def floats(*shape: int) -> wp.array:
            return wp.zeros(shape, dtype=float)

        def spatials() -> wp.array:
            return wp.zeros((worlds, nbody), dtype=wp.spatial_vector)

        with wp.ScopedDevice(self.device):
            self._tables = build_tables(mjm, model)
            self.touch_counter = TouchCounter(mjm, worlds)
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
