"""The kinematic tree: ancestors of bodies, and actuators between different branches."""

import mujoco
import numpy as np


def ancestors(m: mujoco.MjModel, body: int) -> list[int]:
    """A body and all its ancestors, up to the world."""
    out = [body]
    while out[-1]:
        out.append(int(m.body_parentid[out[-1]]))
    return out


def one_chain(m: mujoco.MjModel, bodies: set[int]) -> bool:
    """Whether all bodies are on one chain, each an ancestor of the next; welded bodies count as one."""
    moving = {int(m.body_weldid[b]) for b in bodies} - {0}
    return all(a in ancestors(m, b) or b in ancestors(m, a) for a in moving for b in moving)


def lone_free_bodies(m: mujoco.MjModel) -> list[int]:
    """Bodies with a free joint whose tree has no other joint."""
    return [
        int(m.jnt_bodyid[joint])
        for joint in np.flatnonzero(m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))
        if m.tree_dofnum[m.dof_treeid[m.jnt_dofadr[joint]]] == 6
    ]


def between_sites(m: mujoco.MjModel) -> np.ndarray:
    """Actuators at a site with a reference site, and slider-cranks, as booleans."""
    crank = m.actuator_trntype == int(mujoco.mjtTrn.mjTRN_SLIDERCRANK)
    site = m.actuator_trntype == int(mujoco.mjtTrn.mjTRN_SITE)
    return np.asarray(crank | (site & (m.actuator_trnid[:, 1] >= 0)))


def branching_actuators(m: mujoco.MjModel) -> np.ndarray:
    """Actuators between sites that couple dofs not coupled by the inertia: implicitfast drops these derivatives."""
    branching = np.zeros(m.nu, dtype=bool)
    if m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST):
        for u in np.flatnonzero(between_sites(m)):
            branching[u] = not one_chain(m, {int(m.site_bodyid[s]) for s in m.actuator_trnid[u]})
    return branching


def common_bodies(m: mujoco.MjModel) -> np.ndarray:
    """By actuator, the common ancestor of its site and its reference site; 0 for other actuators."""
    out = np.zeros(m.nu, dtype=np.int32)
    for u in np.flatnonzero(between_sites(m)):
        if m.actuator_trntype[u] == int(mujoco.mjtTrn.mjTRN_SITE):
            first, second = (ancestors(m, int(m.site_bodyid[s])) for s in m.actuator_trnid[u])
            out[u] = next(b for b in first if b in second)
    return out


def motors_apart(mjm: mujoco.MjModel) -> bool:
    """Whether every actuator drives a different joint."""
    joints = np.all(mjm.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
    return bool(joints) and len(set(mjm.actuator_trnid[:, 0])) == len(mjm.actuator_trnid)
