"""Index tables of a model that the adjoint kernels read, worked out once on the host."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import warp as wp

from msk_ray.step.adjoint.coverage.features import has_spring, joint_transmission, site_transmission
from msk_ray.step.adjoint.coverage.model_elements import among
from msk_ray.step.forward.model_tree import lone_free_bodies

_ROTATION_OFFSET = {mujoco.mjtJoint.mjJNT_FREE: 3, mujoco.mjtJoint.mjJNT_BALL: 0}


@dataclass(frozen=True)
class Tables:
    """Device arrays of int32."""

    body_lastdof: wp.array
    """Last dof that moves each body, -1 for a fixed one; its ancestors follow by dof_parentid. Shape (nbody,)."""
    body_subtree_end: wp.array
    """One past the last body of each subtree: MuJoCo numbers bodies depth first. Shape (nbody,)."""
    dof_first: wp.array
    """First dof of the joint each dof belongs to; a free joint counts as three slides and a ball. Shape (nv,)."""
    dof_last: wp.array
    """Last dof of the same. Shape (nv,)."""
    dof_spring_qpos: wp.array
    """qpos address of a hinge or slide with a spring, else -1. Shape (nv,)."""
    inertia_address: wp.array
    """Place of M_ij (j ≤ i) in the sparse inertia, -1 where it is zero. Shape (nv, nv)."""
    implicit_address: wp.array
    """The same, but -1 also for dofs of `free_body`. Shape (nv, nv)."""
    free_body: wp.array
    """Bodies that implicitfast integrates with their gyroscopic forces; none with other integrators."""
    segment_tendon: wp.array
    """Tendon of each stretch of path between two neighbouring sites, with or without a geom. Shape (segments,)."""
    segment_first: wp.array
    """Place in the wrap list of its first site. Shape (segments,)."""
    segment_geom: wp.array
    """Place of the geom it may wrap around, -1 for none. Shape (segments,)."""
    segment_last: wp.array
    """Place of its last site. Shape (segments,)."""
    has_wrapping: bool
    """Whether any tendon passes a wrapping geom."""
    has_scalar_rows: bool
    """Whether any joint or tendon makes constraint rows."""
    has_turning_transmission: bool
    """Whether an actuator drives a free or ball joint."""
    has_site_transmission: bool
    """Whether an actuator drives a site without a reference site."""
    has_turning_spring: bool
    """Whether a free or ball joint has a spring."""


def _dof_groups(mjm: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    first = np.arange(mjm.nv, dtype=np.int32)
    last = first.copy()
    for joint in range(mjm.njnt):
        offset = _ROTATION_OFFSET.get(mujoco.mjtJoint(mjm.jnt_type[joint]))
        if offset is not None:
            turn = int(mjm.jnt_dofadr[joint]) + offset
            first[turn : turn + 3] = turn
            last[turn : turn + 3] = turn + 2
    return first, last


def _segments(mjm: mujoco.MjModel) -> np.ndarray:
    """(tendon, first, geom, last) of every stretch between two sites, shape (segments, 4)."""
    wrap = mujoco.mjtWrap
    out = []
    for tendon in range(mjm.ntendon):
        first = int(mjm.tendon_adr[tendon])
        end = first + int(mjm.tendon_num[tendon])
        for place in range(first, end - 1):
            kinds = [int(k) for k in mjm.wrap_type[place : place + 2]]
            if kinds[0] != int(wrap.mjWRAP_SITE):
                continue
            if kinds[1] == int(wrap.mjWRAP_SITE):
                out.append((tendon, place, -1, place + 1))
            elif kinds[1] in (int(wrap.mjWRAP_SPHERE), int(wrap.mjWRAP_CYLINDER)):
                out.append((tendon, place, place + 1, place + 2))
    return np.array(out, dtype=np.int32).reshape(-1, 4)


def _has_scalar_rows(mjm: mujoco.MjModel) -> bool:
    return bool(
        np.any(mjm.jnt_limited)
        or np.any(mjm.dof_frictionloss)
        or np.any(mjm.tendon_limited)
        or np.any(mjm.tendon_frictionloss)
        or np.any(np.isin(mjm.eq_type, [int(mujoco.mjtEq.mjEQ_JOINT), int(mujoco.mjtEq.mjEQ_TENDON)]))
    )


def build_tables(mjm: mujoco.MjModel, model: Any) -> Tables:
    """Tables for the C model `mjm` and its mujoco_warp copy `model`, on Warp's current device."""
    lastdof = np.full(mjm.nbody, -1, dtype=np.int32)
    subtree_end = np.arange(1, mjm.nbody + 1, dtype=np.int32)
    for body in range(1, mjm.nbody):
        count = int(mjm.body_dofnum[body])
        inherited = lastdof[mjm.body_parentid[body]]
        lastdof[body] = mjm.body_dofadr[body] + count - 1 if count else inherited
    for body in range(mjm.nbody - 1, 0, -1):
        parent = mjm.body_parentid[body]
        subtree_end[parent] = max(subtree_end[parent], subtree_end[body])
    first, last = _dof_groups(mjm)
    springs = np.full(mjm.nv, -1, dtype=np.int32)
    enabled = not mjm.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SPRING
    sprung, turning = has_spring(mjm) & enabled, among(mjm.jnt_type, _ROTATION_OFFSET)
    straight = sprung & ~turning
    springs[mjm.jnt_dofadr[straight]] = mjm.jnt_qposadr[straight]
    address = np.full((mjm.nv, mjm.nv), -1, dtype=np.int32)
    nnz, start, column = model.M_rownnz.numpy(), model.M_rowadr.numpy(), model.M_colind.numpy()
    for i in range(mjm.nv):
        for k in range(start[i], start[i] + nnz[i]):
            address[i, column[k]] = k
    free = lone_free_bodies(mjm) if mjm.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST) else []
    implicit = address.copy()
    for body in free:
        dofs = slice(mjm.body_dofadr[body], mjm.body_dofadr[body] + 6)
        implicit[dofs, dofs] = -1

    segments = _segments(mjm)

    def ints(values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=int)

    return Tables(
        body_lastdof=ints(lastdof),
        body_subtree_end=ints(subtree_end),
        dof_first=ints(first),
        dof_last=ints(last),
        dof_spring_qpos=ints(springs),
        inertia_address=ints(address),
        implicit_address=ints(implicit),
        free_body=ints(np.array(free, dtype=np.int32)),
        segment_tendon=ints(segments[:, 0].copy()),
        segment_first=ints(segments[:, 1].copy()),
        segment_geom=ints(segments[:, 2].copy()),
        segment_last=ints(segments[:, 3].copy()),
        has_wrapping=bool(np.any(segments[:, 2] >= 0)),
        has_scalar_rows=_has_scalar_rows(mjm),
        has_turning_transmission=bool(joint_transmission(*_ROTATION_OFFSET)(mjm)),
        has_site_transmission=bool(site_transmission(False)(mjm)),
        has_turning_spring=bool(np.any(sprung & turning)),
    )
