"""Kinds of tendons in a model, each as an array of booleans by tendon."""

import mujoco
import numpy as np

from msk_ray.step.forward.model_tree import one_chain


def spatial_tendons(m: mujoco.MjModel) -> np.ndarray:
    """Tendons over sites and geoms; the others are fixed."""
    first = m.wrap_type[m.tendon_adr] if m.ntendon else np.zeros(0)
    return np.asarray(first != int(mujoco.mjtWrap.mjWRAP_JOINT))


def tendon_armature(m: mujoco.MjModel) -> np.ndarray:
    """Spatial tendons with armature, their own or an actuator's, so that their inertia depends on the pose."""
    has = np.array(m.tendon_armature != 0)
    geared = getattr(m, "actuator_armature", np.zeros(m.nu))
    for u in np.flatnonzero(geared):
        if m.actuator_trntype[u] == int(mujoco.mjtTrn.mjTRN_TENDON):
            has[m.actuator_trnid[u, 0]] = True
    return has & spatial_tendons(m)


def branching_tendons(m: mujoco.MjModel) -> np.ndarray:
    """Spatial tendons whose velocity-dependent force couples dofs not coupled by the inertia.

    implicitfast drops these derivatives.
    """
    fast = m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    return between_branches(m) & _depends_on_velocity(m) & fast


def between_branches(m: mujoco.MjModel) -> np.ndarray:
    """Spatial tendons over bodies on different branches of the tree."""
    branching = np.zeros(m.ntendon, dtype=bool)
    for tendon in np.flatnonzero(spatial_tendons(m)):
        bodies = {
            int(owner[m.wrap_objid[place]])
            for place in range(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon])
            for kind, owner in (
                (mujoco.mjtWrap.mjWRAP_SITE, m.site_bodyid),
                (mujoco.mjtWrap.mjWRAP_SPHERE, m.geom_bodyid),
                (mujoco.mjtWrap.mjWRAP_CYLINDER, m.geom_bodyid),
            )
            if int(m.wrap_type[place]) == int(kind)
        }
        branching[tendon] = not one_chain(m, bodies)
    return branching


def _depends_on_velocity(m: mujoco.MjModel) -> np.ndarray:
    """Tendons with a damper, or with an actuator whose force depends on velocity."""
    damped = np.array((m.tendon_damping != 0) | np.any(m.tendon_dampingpoly != 0, axis=-1))
    muscle, affine = int(mujoco.mjtGain.mjGAIN_MUSCLE), int(mujoco.mjtGain.mjGAIN_AFFINE)
    moving = (m.actuator_gaintype == muscle) | ((m.actuator_gaintype == affine) & (m.actuator_gainprm[:, 2] != 0))
    moving |= (m.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)) & (m.actuator_biasprm[:, 2] != 0)
    moving |= (m.actuator_damping != 0) | np.any(m.actuator_dampingpoly != 0, axis=-1)
    for u in np.flatnonzero(moving & (m.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON))):
        damped[m.actuator_trnid[u, 0]] = True
    return damped
