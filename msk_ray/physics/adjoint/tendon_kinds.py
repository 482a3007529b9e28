"""Kinds of tendons in a model, each as an array of booleans by tendon."""

import mujoco
import numpy as np

from msk_ray.physics.branches import one_chain


def spatial_tendons(m: mujoco.MjModel) -> np.ndarray:
    """Tendons over sites and geoms; the others are fixed."""
    first = m.wrap_type[m.tendon_adr] if m.ntendon else np.zeros(0)
    return np.asarray(first != int(mujoco.mjtWrap.mjWRAP_JOINT))


def tendon_armature(m: mujoco.MjModel) -> np.ndarray:
    """Spatial tendons with armature of their own or of an actuator on them, whose inertia turns with the pose."""
    has = np.array(m.tendon_armature != 0)
    geared = getattr(m, "actuator_armature", np.zeros(m.nu))
    for u in np.flatnonzero(geared):
        if m.actuator_trntype[u] == int(mujoco.mjtTrn.mjTRN_TENDON):
            has[m.actuator_trnid[u, 0]] = True
    return has & spatial_tendons(m)


def branching_tendons(m: mujoco.MjModel) -> np.ndarray:
    """Spatial tendons whose force couples dofs that the inertia does not: implicitfast drops those slopes."""
    found = np.zeros(m.ntendon, dtype=bool)
    if m.opt.integrator != int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST):
        return found
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
        found[tendon] = not one_chain(m, bodies)
    return found
