"""The table of model features: which of them the adjoint differentiates, and how to find them."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from msk_ray.step.adjoint.coverage.contact_kinds import EXACT_PAIRS, FIELD_PAIRS, pairs_of
from msk_ray.step.adjoint.coverage.model_elements import Finder, among, named, option, where
from msk_ray.step.forward.model_tree import between_sites, branching_actuators, lone_free_bodies
from msk_ray.step.forward.tendon_kinds import branching_tendons, spatial_tendons, tendon_armature

_OBJ = mujoco.mjtObj
_TRN = mujoco.mjtTrn
_JNT = mujoco.mjtJoint
_EQ = mujoco.mjtEq
_DYN = mujoco.mjtDyn
_INTEGRATOR = mujoco.mjtIntegrator


@dataclass(frozen=True)
class Feature:
    """One row of the table."""

    name: str
    """What a user would call it."""
    exact: bool
    """Whether `tape_all` and `tape_per_substep` differentiate it."""
    find: Finder
    """Names of the elements of a model that use it."""
    note: str = ""
    """What is approximated or assumed, or why it is refused."""
    counted: bool = False
    """Whether single contacts may be approximated, each of which is counted."""
    instead: str = ""
    """What to write in the model where it is refused."""


def _joint_type(*kinds: int) -> Finder:
    return where(_OBJ.mjOBJ_JOINT, "joint", lambda m: among(m.jnt_type, kinds))


def _limited(*kinds: int) -> Finder:
    return where(_OBJ.mjOBJ_JOINT, "joint", lambda m: among(m.jnt_type, kinds) & (m.jnt_limited != 0))


def has_spring(m: mujoco.MjModel) -> np.ndarray:
    """Which joints have a spring."""
    stiff = np.asarray(m.jnt_stiffness) != 0
    return stiff | np.any(m.jnt_stiffnesspoly != 0, axis=-1) if hasattr(m, "jnt_stiffnesspoly") else stiff


def _spring(*kinds: int) -> Finder:
    return where(_OBJ.mjOBJ_JOINT, "joint", lambda m: among(m.jnt_type, kinds) & has_spring(m))


def _actuator(field: str, *kinds: int) -> Finder:
    return where(_OBJ.mjOBJ_ACTUATOR, "actuator", lambda m: among(getattr(m, field), kinds))


def joint_transmission(*kinds: int) -> Finder:
    """Actuators that drive joints of some types."""

    def test(m: mujoco.MjModel) -> np.ndarray:
        on_joint = among(m.actuator_trntype, (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT))
        joint = np.clip(m.actuator_trnid[:, 0], 0, max(m.njnt - 1, 0))
        return on_joint & among(m.jnt_type[joint], kinds) if m.njnt else on_joint

    return where(_OBJ.mjOBJ_ACTUATOR, "actuator", test)


def site_transmission(referred: bool) -> Finder:
    """Actuators at sites, with or without a reference site."""

    def test(m: mujoco.MjModel) -> np.ndarray:
        return np.asarray((m.actuator_trntype == int(_TRN.mjTRN_SITE)) & ((m.actuator_trnid[:, 1] >= 0) == referred))

    return where(_OBJ.mjOBJ_ACTUATOR, "actuator", test)


def _actuators_at(test: Callable[[mujoco.MjModel], np.ndarray]) -> Finder:
    return where(_OBJ.mjOBJ_ACTUATOR, "actuator", test)


def _tendon(test: Callable[[mujoco.MjModel], np.ndarray]) -> Finder:
    return where(_OBJ.mjOBJ_TENDON, "tendon", test)


def _foreign_actuator(m: mujoco.MjModel) -> np.ndarray:
    return np.asarray(
        (m.actuator_dyntype > int(mujoco.mjtDyn.mjDYN_MUSCLE))
        | (m.actuator_gaintype > int(mujoco.mjtGain.mjGAIN_MUSCLE))
        | (m.actuator_biastype > int(mujoco.mjtBias.mjBIAS_MUSCLE))
    )


def _equality(*kinds: int) -> Finder:
    return where(_OBJ.mjOBJ_EQUALITY, "equality", lambda m: among(m.eq_type, kinds))


def _bounded_gravcomp(m: mujoco.MjModel) -> np.ndarray:
    """Joints whose actuators carry the weight, but may be held at their limit, or are off."""
    off = m.nu == 0 or bool(m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    weight = bool(np.any(m.body_gravcomp != 0))
    return (m.jnt_actgravcomp != 0) & ((m.jnt_actfrclimited != 0) | off) & weight


def _in_fluid(m: mujoco.MjModel) -> bool:
    return bool(m.opt.density > 0 or m.opt.viscosity > 0)


def _lone_free_bodies(m: mujoco.MjModel) -> list[str]:
    if m.opt.integrator != int(_INTEGRATOR.mjINT_IMPLICITFAST):
        return []
    return named(m, _OBJ.mjOBJ_BODY, "body", lone_free_bodies(m))


def _odd_flags(m: mujoco.MjModel) -> list[str]:
    """Enabled flags that change constraints in ways the adjoint does not follow."""
    flags = mujoco.mjtEnableBit
    names = ("DIAGEXACT", "SPECULATIVE", "IPC")
    return [f"flag {n.lower()}" for n in names if m.opt.enableflags & int(getattr(flags, f"mjENBL_{n}", 0))]


def _odd_surfaces(m: mujoco.MjModel) -> list[str]:
    geoms: set[int] = set()
    for field in ("geom_adhesion", "geom_surfacevel"):
        values = getattr(m, field, None)
        if values is not None:
            geoms |= {int(i) for i in np.flatnonzero(np.any(values != 0, axis=tuple(range(1, values.ndim))))}
    return named(m, _OBJ.mjOBJ_GEOM, "geom", sorted(geoms))


_EXACT_INTEGRATORS = (_INTEGRATOR.mjINT_EULER, _INTEGRATOR.mjINT_IMPLICITFAST, _INTEGRATOR.mjINT_RK4)


def _under_rk4(find: Finder) -> Finder:
    return lambda m: find(m) if m.opt.integrator == _INTEGRATOR.mjINT_RK4 else []


def _integrator_name(model: mujoco.MjModel) -> str:
    return f"integrator {_INTEGRATOR(model.opt.integrator).name.removeprefix('mjINT_')}"


def _integrator(*kinds: int) -> Finder:
    return option(lambda m: m.opt.integrator in kinds, "option integrator")


FEATURES: tuple[Feature, ...] = (
    Feature("integrator Euler, implicit damping on or off", True, _integrator(_INTEGRATOR.mjINT_EULER)),
    Feature("integrator implicitfast", True, _integrator(_INTEGRATOR.mjINT_IMPLICITFAST)),
    Feature(
        "integrator RK4",
        True,
        _integrator(_INTEGRATOR.mjINT_RK4),
        "not with tape_all; the backward pass solves once more for the accelerations of the four stages",
    ),
    Feature(
        "RK4 with connect and weld equalities",
        False,
        _under_rk4(_equality(_EQ.mjEQ_CONNECT, _EQ.mjEQ_WELD)),
        "mujoco_warp 4.0.0 builds these rows of a stage from the velocities of the stage before",
        instead='integrator="Euler" or "implicitfast"',
    ),
    Feature(
        "integrators implicit, discrete",
        False,
        lambda m: [] if m.opt.integrator in _EXACT_INTEGRATORS else [_integrator_name(m)],
        "their matrices hold slopes of Coriolis forces and of constraints, whose own slopes are missing",
        instead='integrator="Euler" or "implicitfast"; --integrator of gradcheck tries one',
    ),
    Feature(
        "solvers Newton and CG",
        True,
        option(lambda m: m.opt.solver != mujoco.mjtSolver.mjSOL_PGS, "option solver"),
        "as far as the solver has converged: its residual is reported; CG in float32 stops about ten times earlier",
    ),
    Feature(
        "noslip iterations",
        False,
        option(lambda m: m.opt.noslip_iterations > 0, "option noslip_iterations"),
        "sweeps over the friction forces after the solver, which stop before they converge: no equation says where",
        instead='noslip_iterations="0"; a larger impratio with cone="elliptic" also reduces slip',
    ),
    Feature(
        "mocap bodies",
        True,
        where(_OBJ.mjOBJ_BODY, "body", lambda m: m.body_mocapid >= 0),
        "constants: they stay where the model's bodies are",
    ),
    Feature("joints free, hinge, slide", True, _joint_type(_JNT.mjJNT_FREE, _JNT.mjJNT_HINGE, _JNT.mjJNT_SLIDE)),
    Feature("ball joints", True, _joint_type(_JNT.mjJNT_BALL)),
    Feature("springs on hinge and slide joints", True, _spring(_JNT.mjJNT_HINGE, _JNT.mjJNT_SLIDE)),
    Feature("springs on free and ball joints", True, _spring(_JNT.mjJNT_FREE, _JNT.mjJNT_BALL)),
    Feature("limits of hinge and slide joints", True, _limited(_JNT.mjJNT_HINGE, _JNT.mjJNT_SLIDE)),
    Feature("limits of ball joints", True, _limited(_JNT.mjJNT_BALL)),
    Feature(
        "dof friction loss",
        True,
        lambda m: named(m, _OBJ.mjOBJ_JOINT, "joint", np.unique(m.dof_jntid[m.dof_frictionloss != 0])),
    ),
    Feature("gravity compensation", True, where(_OBJ.mjOBJ_BODY, "body", lambda m: m.body_gravcomp != 0)),
    Feature(
        "gravity compensation by actuators, under a force limit of the joint or without actuation",
        False,
        where(_OBJ.mjOBJ_JOINT, "joint", _bounded_gravcomp),
        "the weight is carried only in part, or not at all",
        instead='actuatorgravcomp="false"',
    ),
    Feature("drag of a fluid, inertia-box model", True, option(_in_fluid, "option density or viscosity")),
    Feature(
        "drag of a fluid, ellipsoid model",
        False,
        where(_OBJ.mjOBJ_GEOM, "geom", lambda m: (m.geom_fluid[:, 0] > 0) & _in_fluid(m)),
        "slopes of lift and added mass are missing",
        instead='fluidshape="none" for the inertia-box model',
    ),
    Feature("contacts, pyramidal and elliptic cones, condim 1, 3, 4, 6", True, option(lambda m: m.ngeom > 1, "geoms")),
    Feature(
        "contact of plane, sphere, capsule, ellipsoid, cylinder, box, mesh, with each other",
        True,
        pairs_of(EXACT_PAIRS, set()),
        "contacts without a derivative of their own (parallel edges, the side of a cylinder clipped by a face, its cap "
        "on a face, a cylinder upright on a plane) get that of the nearest law; `grad/approximated_share` counts how "
        "often",
        counted=True,
    ),
    Feature(
        "contact of height fields with sphere, capsule, ellipsoid, cylinder, box, mesh",
        True,
        pairs_of(FIELD_PAIRS, set()),
        "exact for each triangle that touches; what lies flat on a triangle, or has sunk into it beyond its sides, has "
        "no derivative of its own and is counted as above",
        counted=True,
    ),
    Feature(
        "contact with signed distance fields",
        False,
        pairs_of(None, EXACT_PAIRS | FIELD_PAIRS),
        "the contact's place is where a search has ended",
    ),
    Feature(
        "contact adhesion and surface velocity", False, _odd_surfaces, "slopes of these forces at contacts are missing"
    ),
    Feature("fixed tendons", True, _tendon(lambda m: ~spatial_tendons(m))),
    Feature(
        "spatial tendons: sites, pulleys, sphere and cylinder wrapping, also inside the geom",
        True,
        _tendon(spatial_tendons),
    ),
    Feature("tendon springs and dampers", True, _tendon(lambda m: (m.tendon_stiffness != 0) | (m.tendon_damping != 0))),
    Feature("tendon limits", True, _tendon(lambda m: m.tendon_limited != 0)),
    Feature("tendon friction loss", True, _tendon(lambda m: m.tendon_frictionloss != 0)),
    Feature(
        "armature of fixed tendons", True, _tendon(lambda m: ~spatial_tendons(m) & np.asarray(m.tendon_armature != 0))
    ),
    Feature(
        "armature of spatial tendons",
        False,
        _tendon(tendon_armature),
        "its velocity products need third derivatives of the tendon's length",
        instead='armature="0"',
    ),
    Feature(
        "tendon bound on actuator force",
        False,
        _tendon(lambda m: m.tendon_actfrclimited != 0),
        "it couples all actuators of a tendon",
        instead='actuatorfrclimited="false", and a forcerange for each actuator',
    ),
    Feature(
        "implicitfast with velocity-dependent force on a spatial tendon between branches",
        False,
        _tendon(branching_tendons),
        "mujoco_warp takes only those slopes of the force that couple dofs which the inertia couples",
        instead='integrator="Euler"',
    ),
    Feature(
        "implicitfast with a free body that has no other joints",
        True,
        _lone_free_bodies,
        "damping by actuators and tendons on it is explicit in mujoco_warp but implicit in C MuJoCo; the gradient is "
        "mujoco_warp's",
    ),
    Feature("joint and tendon equalities", True, _equality(_EQ.mjEQ_JOINT, _EQ.mjEQ_TENDON)),
    Feature(
        "connect and weld equalities",
        True,
        _equality(_EQ.mjEQ_CONNECT, _EQ.mjEQ_WELD),
        "the velocity stage runs once more before each substep, which mujoco_warp 4.0.0 leaves a step behind here",
    ),
    Feature(
        "flex equalities",
        False,
        where(_OBJ.mjOBJ_EQUALITY, "equality", lambda m: m.eq_type > int(_EQ.mjEQ_TENDON)),
        "soft bodies are not covered",
    ),
    Feature(
        "actuators: motor, position, velocity, affine, filter, integrator, muscle",
        True,
        _actuator(
            "actuator_dyntype",
            *(_DYN.mjDYN_NONE, _DYN.mjDYN_INTEGRATOR, _DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT, _DYN.mjDYN_MUSCLE),
        ),
    ),
    Feature(
        "actuators with user or DC-motor dynamics, gain or bias",
        False,
        where(_OBJ.mjOBJ_ACTUATOR, "actuator", _foreign_actuator),
        "a motor's currents, temperature and bristles are states with laws of their own; user laws are unknown",
    ),
    Feature("transmission to hinge and slide joints", True, joint_transmission(_JNT.mjJNT_HINGE, _JNT.mjJNT_SLIDE)),
    Feature(
        "transmission to free and ball joints, also in the parent's frame",
        True,
        joint_transmission(_JNT.mjJNT_FREE, _JNT.mjJNT_BALL),
        "a rotational servo more than half a turn from its target is not wrapped",
    ),
    Feature("transmission to tendons", True, _actuator("actuator_trntype", _TRN.mjTRN_TENDON)),
    Feature("transmission to sites", True, site_transmission(False)),
    Feature("transmission to sites with a reference site, and slider-cranks", True, _actuators_at(between_sites)),
    Feature(
        "implicitfast with an actuator between sites of different branches",
        False,
        _actuators_at(branching_actuators),
        "as above",
        instead='integrator="Euler"',
    ),
    Feature(
        "transmission to bodies (adhesion), SO(3)",
        False,
        where(
            _OBJ.mjOBJ_ACTUATOR,
            "actuator",
            lambda m: (
                ~among(
                    m.actuator_trntype,
                    (
                        *(_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT, _TRN.mjTRN_TENDON, _TRN.mjTRN_SITE),
                        _TRN.mjTRN_SLIDERCRANK,
                    ),
                )
            ),
        ),
        "the moment of adhesion is a mean over the contacts that a body happens to have",
    ),
    Feature(
        "flags diagexact, speculative, ipc", False, _odd_flags, "they change which constraints there are and their laws"
    ),
    Feature("flexes", False, option(lambda m: m.nflex > 0, "flex"), "soft bodies are not covered"),
    Feature(
        "plugins",
        False,
        option(lambda m: m.nplugin > 0, "plugin"),
        "they are programs of their own, which mujoco_warp does not run: fd_jacobian refuses them too",
    ),
)
