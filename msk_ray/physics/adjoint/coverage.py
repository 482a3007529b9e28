"""Which model features the adjoint differentiates: one table for the check before the first step and for the docs."""

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

from msk_ray.errors import UnsupportedModelError
from msk_ray.physics.adjoint.tendon_kinds import branching_tendons, spatial_tendons, tendon_armature
from msk_ray.physics.branches import between_sites, branching_actuators, lone_free_bodies

_OBJ = mujoco.mjtObj
_GEOM = mujoco.mjtGeom
_TRN = mujoco.mjtTrn
_JNT = mujoco.mjtJoint
_EQ = mujoco.mjtEq
_INTEGRATOR = mujoco.mjtIntegrator


Finder = Callable[[mujoco.MjModel], list[str]]


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
    """What is approximated or assumed."""
    partly: bool = False
    """Whether some slopes are approximated, as the note says."""
    instead: str = ""
    """What to write in the model where it is refused."""


def _named(model: mujoco.MjModel, kind: mujoco.mjtObj, word: str, ids: Iterable[int]) -> list[str]:
    return [f"{word} {mujoco.mj_id2name(model, kind, int(i)) or int(i)}" for i in ids]


def _among(values: np.ndarray, kinds: Iterable[int]) -> np.ndarray:
    return np.isin(values, [int(k) for k in kinds])


def _where(kind: mujoco.mjtObj, word: str, test: Callable[[mujoco.MjModel], np.ndarray]) -> Finder:
    return lambda model: _named(model, kind, word, np.flatnonzero(test(model)))


def _option(present: Callable[[mujoco.MjModel], bool], text: str) -> Finder:
    return lambda model: [text] if present(model) else []


def _joint_type(*kinds: int) -> Finder:
    return _where(_OBJ.mjOBJ_JOINT, "joint", lambda m: _among(m.jnt_type, kinds))


def _limited(*kinds: int) -> Finder:
    return _where(_OBJ.mjOBJ_JOINT, "joint", lambda m: _among(m.jnt_type, kinds) & (m.jnt_limited != 0))


def _spring(*kinds: int) -> Finder:
    def test(m: mujoco.MjModel) -> np.ndarray:
        stiff = np.asarray(m.jnt_stiffness) != 0
        if hasattr(m, "jnt_stiffnesspoly"):
            stiff = stiff | np.any(m.jnt_stiffnesspoly != 0, axis=-1)
        return _among(m.jnt_type, kinds) & stiff

    return _where(_OBJ.mjOBJ_JOINT, "joint", test)


def _actuator(field: str, *kinds: int) -> Finder:
    return _where(_OBJ.mjOBJ_ACTUATOR, "actuator", lambda m: _among(getattr(m, field), kinds))


def _joint_transmission(*kinds: int) -> Finder:
    def test(m: mujoco.MjModel) -> np.ndarray:
        on_joint = _among(m.actuator_trntype, (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT))
        joint = np.clip(m.actuator_trnid[:, 0], 0, max(m.njnt - 1, 0))
        return on_joint & _among(m.jnt_type[joint], kinds) if m.njnt else on_joint

    return _where(_OBJ.mjOBJ_ACTUATOR, "actuator", test)


def _site_transmission(referred: bool) -> Finder:
    def test(m: mujoco.MjModel) -> np.ndarray:
        return np.asarray((m.actuator_trntype == int(_TRN.mjTRN_SITE)) & ((m.actuator_trnid[:, 1] >= 0) == referred))

    return _where(_OBJ.mjOBJ_ACTUATOR, "actuator", test)


def _actuators_at(test: Callable[[mujoco.MjModel], np.ndarray]) -> Finder:
    return _where(_OBJ.mjOBJ_ACTUATOR, "actuator", test)


def _tendon(test: Callable[[mujoco.MjModel], np.ndarray]) -> Finder:
    return _where(_OBJ.mjOBJ_TENDON, "tendon", test)


def _foreign_actuator(m: mujoco.MjModel) -> np.ndarray:
    return np.asarray(
        (m.actuator_dyntype > int(mujoco.mjtDyn.mjDYN_MUSCLE))
        | (m.actuator_gaintype > int(mujoco.mjtGain.mjGAIN_MUSCLE))
        | (m.actuator_biastype > int(mujoco.mjtBias.mjBIAS_MUSCLE))
    )


def _equality(*kinds: int) -> Finder:
    return _where(_OBJ.mjOBJ_EQUALITY, "equality", lambda m: _among(m.eq_type, kinds))


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
    return _named(m, _OBJ.mjOBJ_BODY, "body", lone_free_bodies(m))


def colliding_pairs(m: mujoco.MjModel) -> set[tuple[int, int]]:
    """Geom pairs that masks, parent filter and exclusions let through or that are listed, types in ascending order."""
    filtered = not m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    excluded = {int(s) for s in m.exclude_signature}

    def lets_through(a: int, b: int) -> bool:
        if not ((m.geom_contype[a] & m.geom_conaffinity[b]) or (m.geom_contype[b] & m.geom_conaffinity[a])):
            return False
        body1, body2 = sorted((int(m.geom_bodyid[a]), int(m.geom_bodyid[b])))
        weld1, weld2 = int(m.body_weldid[body1]), int(m.body_weldid[body2])
        if weld1 == weld2 or (body1 << 16) + body2 in excluded:
            return False
        parents = [int(m.body_weldid[m.body_parentid[w]]) for w in (weld1, weld2)]
        return not (filtered and weld1 and weld2 and (parents[0] == weld2 or parents[1] == weld1))

    pairs = {(int(a), int(b)) for a, b in zip(m.pair_geom1, m.pair_geom2, strict=True)}
    pairs |= {(a, b) for a in range(m.ngeom) for b in range(a + 1, m.ngeom) if lets_through(a, b)}
    return {(a, b) if m.geom_type[a] <= m.geom_type[b] else (b, a) for a, b in pairs}


def geom_pair_name(m: mujoco.MjModel, a: int, b: int) -> str:
    """Names of two geoms and their types."""
    names = _named(m, _OBJ.mjOBJ_GEOM, "geom", (a, b))
    types = [mujoco.mjtGeom(m.geom_type[g]).name.removeprefix("mjGEOM_").lower() for g in (a, b)]
    return f"{names[0]} ({types[0]}) with {names[1]} ({types[1]})"


def _pairs(kinds: set[tuple[int, int]] | None, known: set[tuple[int, int]]) -> Finder:
    """Pairs of the given types, or with None all those of no `known` type."""

    def find(m: mujoco.MjModel) -> list[str]:
        if m.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
            return []
        out = []
        for a, b in sorted(colliding_pairs(m)):
            types = (int(m.geom_type[a]), int(m.geom_type[b]))
            if (types in kinds) if kinds is not None else (types not in known):
                names = _named(m, _OBJ.mjOBJ_GEOM, "geom", (a, b))
                out.append(f"{names[0]} with {names[1]}")
        return out

    return find


def _odd_flags(m: mujoco.MjModel) -> list[str]:
    """Enabled flags that change constraints in ways the adjoint does not follow."""
    flags = mujoco.mjtEnableBit
    names = ("DIAGEXACT", "SPECULATIVE", "IPC")
    return [f"flag {n.lower()}" for n in names if m.opt.enableflags & int(getattr(flags, f"mjENBL_{n}", 0))]


def _odd_surfaces(m: mujoco.MjModel) -> list[str]:
    found: set[int] = set()
    for field in ("geom_adhesion", "geom_surfacevel"):
        values = getattr(m, field, None)
        if values is not None:
            found |= {int(i) for i in np.flatnonzero(np.any(values != 0, axis=tuple(range(1, values.ndim))))}
    return _named(m, _OBJ.mjOBJ_GEOM, "geom", sorted(found))


def _types(first: Iterable[int], second: Iterable[int]) -> set[tuple[int, int]]:
    return {(int(a), int(b)) for a in first for b in second}


_SOLIDS = [
    *(_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_ELLIPSOID, _GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_BOX),
    _GEOM.mjGEOM_MESH,
]
_FIELD_PAIRS = _types([_GEOM.mjGEOM_HFIELD], _SOLIDS)
_EXACT_PAIRS = _types([_GEOM.mjGEOM_PLANE, *_SOLIDS], _SOLIDS)
_DYN = mujoco.mjtDyn


def contact_types(m: mujoco.MjModel) -> set[tuple[int, int]]:
    """Geom types, ascending, of the pairs that may touch."""
    if m.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
        return set()
    return {(int(m.geom_type[a]), int(m.geom_type[b])) for a, b in colliding_pairs(m)}


_EXACT_INTEGRATORS = (_INTEGRATOR.mjINT_EULER, _INTEGRATOR.mjINT_IMPLICITFAST, _INTEGRATOR.mjINT_RK4)


def _under_rk4(find: Finder) -> Finder:
    return lambda m: find(m) if m.opt.integrator == _INTEGRATOR.mjINT_RK4 else []


def _integrator_name(model: mujoco.MjModel) -> str:
    return f"integrator {_INTEGRATOR(model.opt.integrator).name.removeprefix('mjINT_')}"


def _integrator(*kinds: int) -> Finder:
    return _option(lambda m: m.opt.integrator in kinds, "option integrator")


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
        instead='integrator="Euler" or "implicitfast"; --integrator of gradcheck tries one',
    ),
    Feature(
        "solvers Newton and CG",
        True,
        _option(lambda m: m.opt.solver != mujoco.mjtSolver.mjSOL_PGS, "option solver"),
        "as far as the solver has converged: its residual is reported; CG in float32 stops about ten times earlier",
    ),
    Feature(
        "noslip iterations",
        False,
        _option(lambda m: m.opt.noslip_iterations > 0, "option noslip_iterations"),
        instead='noslip_iterations="0"; a larger impratio with cone="elliptic" also reduces slip',
    ),
    Feature(
        "mocap bodies",
        True,
        _where(_OBJ.mjOBJ_BODY, "body", lambda m: m.body_mocapid >= 0),
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
        lambda m: _named(m, _OBJ.mjOBJ_JOINT, "joint", np.unique(m.dof_jntid[m.dof_frictionloss != 0])),
    ),
    Feature("gravity compensation", True, _where(_OBJ.mjOBJ_BODY, "body", lambda m: m.body_gravcomp != 0)),
    Feature(
        "gravity compensation by actuators, under a force limit of the joint or without actuation",
        False,
        _where(_OBJ.mjOBJ_JOINT, "joint", _bounded_gravcomp),
        instead='actuatorgravcomp="false"',
    ),
    Feature("drag of a fluid, inertia-box model", True, _option(_in_fluid, "option density or viscosity")),
    Feature(
        "drag of a fluid, ellipsoid model",
        False,
        _where(_OBJ.mjOBJ_GEOM, "geom", lambda m: (m.geom_fluid[:, 0] > 0) & _in_fluid(m)),
        instead='fluidshape="none" for the inertia-box model',
    ),
    Feature("contacts, pyramidal and elliptic cones, condim 1, 3, 4, 6", True, _option(lambda m: m.ngeom > 1, "geoms")),
    Feature(
        "contact of plane, sphere, capsule, ellipsoid, cylinder, box, mesh, with each other",
        True,
        _pairs(_EXACT_PAIRS, set()),
        "contacts without a derivative of their own (parallel edges, a clipped side that another feature found) get "
        "that of the nearest law; `grad/approximated_share` counts how often",
    ),
    Feature(
        "contact of height fields with sphere, capsule, ellipsoid, cylinder, box, mesh",
        True,
        _pairs(_FIELD_PAIRS, set()),
        "exact for each triangle that touches; what lies flat on a triangle, or has sunk into it beyond its sides, has "
        "no derivative of its own and is counted as above",
    ),
    Feature("contact with signed distance fields", False, _pairs(None, _EXACT_PAIRS | _FIELD_PAIRS)),
    Feature("contact adhesion and surface velocity", False, _odd_surfaces),
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
    Feature("armature of spatial tendons", False, _tendon(tendon_armature), instead='armature="0"'),
    Feature("tendon bound on actuator force", False, _tendon(lambda m: m.tendon_actfrclimited != 0)),
    Feature(
        "implicitfast with velocity-dependent force on a spatial tendon between branches",
        False,
        _tendon(branching_tendons),
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
        _where(_OBJ.mjOBJ_EQUALITY, "equality", lambda m: m.eq_type > int(_EQ.mjEQ_TENDON)),
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
        _where(_OBJ.mjOBJ_ACTUATOR, "actuator", _foreign_actuator),
    ),
    Feature("transmission to hinge and slide joints", True, _joint_transmission(_JNT.mjJNT_HINGE, _JNT.mjJNT_SLIDE)),
    Feature(
        "transmission to free and ball joints, also in the parent's frame",
        True,
        _joint_transmission(_JNT.mjJNT_FREE, _JNT.mjJNT_BALL),
        "a rotational servo more than half a turn from its target is not wrapped",
    ),
    Feature("transmission to tendons", True, _actuator("actuator_trntype", _TRN.mjTRN_TENDON)),
    Feature("transmission to sites", True, _site_transmission(False)),
    Feature("transmission to sites with a reference site, and slider-cranks", True, _actuators_at(between_sites)),
    Feature(
        "implicitfast with an actuator between sites of different branches",
        False,
        _actuators_at(branching_actuators),
        instead='integrator="Euler"',
    ),
    Feature(
        "transmission to bodies (adhesion), SO(3)",
        False,
        _where(
            _OBJ.mjOBJ_ACTUATOR,
            "actuator",
            lambda m: (
                ~_among(
                    m.actuator_trntype,
                    (
                        *(_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT, _TRN.mjTRN_TENDON, _TRN.mjTRN_SITE),
                        _TRN.mjTRN_SLIDERCRANK,
                    ),
                )
            ),
        ),
    ),
    Feature("flags diagexact, speculative, ipc", False, _odd_flags),
    Feature("flexes", False, _option(lambda m: m.nflex > 0, "flex")),
    Feature("plugins", False, _option(lambda m: m.nplugin > 0, "plugin")),
)


def unsupported(model: mujoco.MjModel) -> dict[str, list[str]]:
    """Elements of `model` by the name of the feature that the adjoint does not differentiate."""
    return {feature.name: elements for feature, elements in _refused(model)}


def _refused(model: mujoco.MjModel) -> list[tuple[Feature, list[str]]]:
    found = [(feature, feature.find(model)) for feature in FEATURES if not feature.exact]
    return [(feature, elements) for feature, elements in found if elements]


def check_supported(model: mujoco.MjModel, mode: str) -> None:
    """Raise UnsupportedModelError naming every element that `mode` cannot differentiate, and warn of each one whose
    gradient it only approximates.
    """
    found = _refused(model)
    if found:
        lines = [f"{feature.name} ({_few(elements)})" for feature, elements in found]
        instead = [f" Write {feature.instead}." for feature, _ in found if feature.instead]
        raise UnsupportedModelError(
            f"{mode} does not differentiate {'; '.join(lines)}.{''.join(instead)} Finite differences do: "
            "physics.backward=fd_jacobian in a config, --mode fd_jacobian of gradcheck, backward=FdJacobian() in Python"
        )
    for feature in FEATURES:
        if feature.partly and (elements := feature.find(model)):
            warnings.warn(
                f"{mode} is only partly exact for {feature.name} ({_few(elements)}): {feature.note}", stacklevel=3
            )


def partly_exact(model: mujoco.MjModel) -> list[str]:
    """Elements of `model` whose gradient is approximated in part."""
    return [element for feature in FEATURES if feature.partly for element in feature.find(model)]


def _few(elements: list[str]) -> str:
    return ", ".join(elements[:5]) + (" …" if len(elements) > 5 else "")


def table() -> str:
    """The table as Markdown, feature by mode."""
    rows = ["| feature | tape_all, tape_per_substep | fd_jacobian | note |", "|---|---|---|---|"]
    for f in FEATURES:
        state = ("partly exact" if f.partly else "exact") if f.exact else "raises"
        rows.append(f"| {f.name} | {state} | approximate | {f.note} |")
    return "\n".join(rows)
