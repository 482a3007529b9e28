"""`myoleg26`: two legs of 13 Hill-type muscles each under one trunk, from the tables in `tables.py`.

The pelvis moves on three slides and three hinges, so qpos is 18 numbers without a quaternion: x, height and -y of the
pelvis [m], its tilt, list and rotation [rad], then hip flexion, adduction, rotation, knee, ankle, toes of the right leg
and of the left. The left leg mirrors the right at the plane z = 0 of the pelvis.

Fibres. Tendons are rigid here, so a fibre takes up the whole excursion of its path, which with the fibre lengths of the
sources leaves the force-length curve. Each muscle is refitted: L0 is the smallest length, not below the source's, for
which the lengths over all joint ranges are in `WINDOW` of the curve and the length in the anatomical position is within
`REFERENCE_SHIFT` of its published value (`FIBRE_REFERENCE`). Largest shortening speeds are kept in m/s, so the joint
speed at which a muscle goes slack is the published one.

Force-length curve. MuJoCo's active curve (two parabolas meeting at half force) from 0 to 2 L0 is the one of its kind
closest to the Gaussian exp(-(l - 1)²/0.45) of Thelen (2003) that the sources use: 0.50 against 0.57 at 0.5 and 1.5 L0.
Its passive curve with a parameter of 0.5 is the closest of its kind to Thelen's up to 1.4 L0, where it gives 0.16 F
against 0.18.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from msk_ray.config import PhysicsConfig
from msk_ray.envs.options import add_grid, add_sky, apply_options
from msk_ray.legs.myoleg26 import tables
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.poses import add_keyframes
from msk_ray.legs.myoleg26.terrain import Terrain

SIDES = ("r", "l")
CURVE = (0.0, 2.0)
"""Fibre lengths, in L0, between which a muscle pulls actively."""
WINDOW = (0.3, 1.6)
"""Fibre lengths, in L0, that the joint ranges may reach; active force is 0.18 F or more there."""
REFERENCE_SHIFT = 0.05
"""Largest change of a fibre's length in the anatomical position, in L0."""
PASSIVE = 0.5
"""Twice the passive force at 1.5 L0, in F."""
LENGTHENING = 1.4
"""Force of a fibre that is stretched fast, in units of its isometric force (Thelen 2003)."""
TIME_CONSTANTS = (0.01, 0.04, 0.2)
"""Activation and deactivation [s] of the sources; width of the blend between them, in excitation."""
ASSIST_PREFIX = "assist_"
_JOINT_DAMPING = 0.5
"""Of every joint of the legs [N m s/rad]."""
_ARMATURE = 0.005
"""Of the same [kg m²]."""
_FRICTION = 0.9
"""Sliding friction of feet and ground."""

_MUSCLE_JOINTS = {
    "hip": ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle"),
    "foot": ("knee_angle", "ankle_angle", "mtp_angle"),
}
_GRID = 9
"""Samples of each joint range at which path lengths are measured."""


def resolve_physics(physics: PhysicsConfig) -> PhysicsConfig:
    """`physics` with this model's values for the settings it leaves null."""
    own = PhysicsConfig(
        integrator="implicitfast",
        cone="elliptic",
        solref=(0.02, 1.0),
        solimp=(0.9, 0.95, 0.005, 0.5, 2.0),
        iterations=20,
    )
    given = {name for name in type(own).model_fields if getattr(physics, name) is not None}
    values = {name: getattr(own, name) for name in type(own).model_fields if name not in given}
    if physics.cone == "pyramidal":
        values["solreffriction"] = None
    return physics.model_copy(update=values).in_substeps(SUBSTEPS)


SUBSTEPS = 5
"""Physics steps of a control step of 20 ms: 4 ms each."""


def build_myoleg26(env: MyoLeg26Settings, physics: PhysicsConfig) -> mujoco.MjModel:
    """Compile the model. ctrl is the excitation of 26 muscles in [0, 1], right leg first, then any assistance."""
    p = resolve_physics(physics)
    spec = _body_spec(env, p)
    # Path lengths do not depend on muscles, so a model without muscles is enough for the fit.
    lengths = path_lengths(spec.compile())
    for side in SIDES:
        for muscle in tables.MUSCLES:
            _add_muscle(spec, muscle, side, lengths[muscle.name])
    if env.assist.epochs:
        for name, _, _ in tables.ROOT:
            spec.add_actuator(name=ASSIST_PREFIX + name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
    add_keyframes(spec)
    return spec.compile()


class PathLengths:
    """Lengths of one muscle's path [m].

    Attributes:
        reference: in the anatomical position.
        shortest, longest: over the grid of joint angles.
    """

    def __init__(self, reference: float, samples: NDArray[np.float64]) -> None:
        self.reference = reference
        self.shortest, self.longest = float(samples.min()), float(samples.max())


def path_lengths(model: mujoco.MjModel) -> dict[str, PathLengths]:
    """Lengths of the right leg's muscle paths over the ranges of the joints they cross."""
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    reference = data.ten_length.copy()
    names = [muscle.name for muscle in tables.MUSCLES]
    samples: dict[str, list[float]] = {name: [] for name in names}
    for crossed in _MUSCLE_JOINTS.values():
        addresses = [int(model.jnt_qposadr[model.joint(f"{name}_r").id]) for name in crossed]
        grids = [_grid(model.joint(f"{name}_r").range) for name in crossed]
        data.qpos[:] = model.qpos0
        for angles in np.stack(np.meshgrid(*grids), axis=-1).reshape(-1, len(crossed)):
            data.qpos[addresses] = angles
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_tendon(model, data)
            for name in names:
                samples[name].append(data.ten_length[model.tendon(f"{name}_r").id])
    return {
        name: PathLengths(float(reference[model.tendon(f"{name}_r").id]), np.array(samples[name])) for name in names
    }


def _grid(ends: NDArray[np.float64]) -> NDArray[np.float64]:
    low, high = ends
    return np.linspace(float(low), float(high), _GRID)


def fit_fibre(muscle: tables.Muscle, lengths: PathLengths) -> tuple[float, float]:
    """Optimal fibre length L0 [m], and the fibre length [L0] in the anatomical position."""
    low, high = WINDOW
    published = tables.FIBRE_REFERENCE[muscle.name]
    below, above = lengths.reference - lengths.shortest, lengths.longest - lengths.reference
    optimum = max(
        muscle.fibre,
        (below + above) / (high - low),
        below / (published + REFERENCE_SHIFT - low),
        above / (high - published + REFERENCE_SHIFT),
    )
    return optimum, min(max(published, low + below / optimum), high - above / optimum)


def _mirrored(vector: tuple[float, float, float], side: str) -> list[float]:
    x, y, z = vector
    return [x, y, z if side == "r" else -z]


def _mirrored_axis(axis: tuple[float, float, float], side: str) -> list[float]:
    """A mirrored axis of rotation: it is reversed, except for its part along the mirrored direction."""
    x, y, z = axis
    return list(axis) if side == "r" else [-x, -y, z]


def _body_spec(env: MyoLeg26Settings, p: PhysicsConfig) -> mujoco.MjSpec:
    """Everything but muscles and keyframes."""
    spec = mujoco.MjSpec()
    spec.modelname = "myoleg26"
    spec.compiler.degree = False
    apply_options(spec, p, env.control_timestep)
    add_sky(spec)
    grid = add_grid(spec)
    world = spec.worldbody
    ground = Terrain(env.terrain).add_to(spec, grid)

    # x forward, y up, z right in the body; x forward, z up in the world.
    half = float(np.sqrt(0.5))
    pelvis = world.add_body(name="pelvis", quat=[half, half, 0.0, 0.0])
    # Camera and light follow: shadows are cast only within a few metres of the light.
    along = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    pelvis.add_camera(name="track", mode=along, pos=[0.3, 0.2, 3.2], xyaxes=[1, 0, 0, 0, 1, 0])
    pelvis.add_light(mode=along, pos=[0, 6, 0], dir=[0, -1, 0], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    for name, kind, axis in tables.ROOT:
        joint_type = mujoco.mjtJoint.mjJNT_SLIDE if kind == "slide" else mujoco.mjtJoint.mjJNT_HINGE
        pelvis.add_joint(name=name, type=joint_type, axis=list(axis))
    _set_inertia(pelvis, tables.PELVIS, "r")
    bodies = {"pelvis": pelvis}
    torso = pelvis.add_body(name="torso", pos=list(tables.TORSO.origin))
    _set_inertia(torso, tables.TORSO, "r")
    touching = [*_trunk_geoms(pelvis, torso)]
    for side in SIDES:
        for segment in tables.LEG:
            parent = bodies.get(segment.parent) or bodies[f"{segment.parent}_{side}"]
            body = parent.add_body(name=f"{segment.name}_{side}", pos=_mirrored(segment.origin, side))
            bodies[f"{segment.name}_{side}"] = body
            _set_inertia(body, segment, side)
        for hinge in tables.JOINTS:
            bodies[f"{hinge.segment}_{side}"].add_joint(
                name=f"{hinge.name}_{side}",
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=_mirrored_axis(hinge.axis, side),
                range=[hinge.lower, hinge.upper],
                limited=True,
                damping=_JOINT_DAMPING,
                stiffness=env.toe_stiffness if hinge.segment == "toes" else 0.0,
                armature=_ARMATURE,
                solref_limit=[0.02, 1.0],
                solimp_limit=[0.9, 0.95, 0.05, 0.5, 2.0],
            )
        touching += _leg_geoms(bodies, side)
        _add_paths(spec, bodies, side)
    for geom in touching:
        for floor in ground:
            _add_contact(spec, floor, geom, p)
    for part in ("shank", "foot"):
        # Legs must not pass through each other. Frictionless, so that they slide off.
        _add_contact(spec, f"{part}_r", f"{part}_l", p, condim=1)
    return spec


def _set_inertia(body: mujoco.MjsBody, segment: tables.Segment, side: str) -> None:
    body.mass = segment.mass
    body.ipos = _mirrored(segment.centre, side)
    body.inertia = list(segment.inertia)
    body.explicitinertial = True


_BONE = {"contype": 0, "conaffinity": 0, "rgba": [0.85, 0.8, 0.7, 1.0]}


def _capsule(body: mujoco.MjsBody, name: str, start: list[float], end: list[float], radius: float) -> str:
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    body.add_geom(name=name, type=kind, fromto=[*start, *end], size=[radius, 0, 0], **_BONE)
    return name


def _sphere(body: mujoco.MjsBody, name: str, centre: list[float], radius: float) -> str:
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=centre, size=[radius, 0, 0], **_BONE)
    return name


def _trunk_geoms(pelvis: mujoco.MjsBody, torso: mujoco.MjsBody) -> list[str]:
    """Primitives of pelvis and trunk, which touch the ground after a fall."""
    _sphere(torso, "head", [0.0, 0.65, 0.0], 0.1)
    return [
        _sphere(pelvis, "hips", [-0.07, 0.0, 0.0], 0.11),
        _capsule(torso, "trunk", [-0.03, 0.1, 0.0], [-0.03, 0.45, 0.0], 0.12),
    ]


def _leg_geoms(bodies: dict[str, mujoco.MjsBody], side: str) -> list[str]:
    """Primitives of a leg; returns those that touch the ground."""
    _capsule(bodies[f"femur_{side}"], f"thigh_{side}", [0.0, -0.05, 0.0], [0.0, -0.34, 0.0], 0.06)
    shank = bodies[f"tibia_{side}"]
    _capsule(shank, f"shank_{side}", [0.0, -0.08, 0.0], [0.0, -0.38, 0.0], 0.04)
    _capsule(bodies[f"calcn_{side}"], f"foot_{side}", [0.03, 0.015, 0.0], [0.14, 0.01, 0.0], 0.03)
    touching = [_sphere(shank, f"knee_{side}", [0.0, -0.01, 0.0], 0.05)]
    for segment, spheres in tables.OUTLINE.items():
        for k, (centre, radius) in enumerate(spheres):
            place = _mirrored(centre, side)
            touching.append(_sphere(bodies[f"{segment}_{side}"], f"sole_{segment}{k}_{side}", place, radius))
    return touching


def _add_contact(spec: mujoco.MjSpec, first: str, second: str, p: PhysicsConfig, condim: int = 3) -> None:
    pair = spec.add_pair(geomname1=first, geomname2=second, condim=condim, margin=0.0)
    assert p.solref is not None
    assert p.solimp is not None
    pair.solref = list(p.solref)
    pair.solimp = list(p.solimp)
    pair.friction = [_FRICTION, _FRICTION, 0.005, 0.0001, 0.0001]
    if p.solreffriction is not None and condim > 1:
        pair.solreffriction = list(p.solreffriction)


def _add_paths(spec: mujoco.MjSpec, bodies: dict[str, mujoco.MjsBody], side: str) -> None:
    """Wrapping cylinders, sites and tendons of a leg."""
    for name, (segment, centre, radius, half_length) in tables.CYLINDERS.items():
        bodies[f"{segment}_{side}"].add_geom(
            name=f"{name}_{side}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            pos=_mirrored(centre, side),
            size=[radius, half_length, 0],
            contype=0,
            conaffinity=0,
            rgba=[0.5, 0.5, 0.9, 0.3],
        )
    for muscle in tables.MUSCLES:
        tendon = spec.add_tendon(name=f"{muscle.name}_{side}", width=0.004, rgba=[0.8, 0.15, 0.15, 1])
        for k, (segment, point) in enumerate(muscle.path):
            site = f"{muscle.name}_{side}_{k}"
            if segment.startswith("wrap:"):
                cylinder = segment.removeprefix("wrap:")
                owner = tables.CYLINDERS[cylinder][0]
                bodies[f"{owner}_{side}"].add_site(name=site, pos=_mirrored(point, side), size=[0.002, 0, 0])
                tendon.wrap_geom(f"{cylinder}_{side}", site)
                continue
            body = bodies.get(segment) or bodies[f"{segment}_{side}"]
            body.add_site(name=site, pos=_mirrored(point, side), size=[0.004, 0, 0])
            tendon.wrap_site(site)


def _add_muscle(spec: mujoco.MjSpec, muscle: tables.Muscle, side: str, lengths: PathLengths) -> None:
    optimum, reference = fit_fibre(muscle, lengths)
    span = (
        reference + (lengths.shortest - lengths.reference) / optimum,
        reference + (lengths.longest - lengths.reference) / optimum,
    )
    force = muscle.force * float(np.cos(muscle.pennation))
    speed = muscle.speed * muscle.fibre / optimum
    actuator = spec.add_actuator(name=f"{muscle.name}_{side}", target=f"{muscle.name}_{side}")
    actuator.trntype = mujoco.mjtTrn.mjTRN_TENDON
    actuator.dyntype = mujoco.mjtDyn.mjDYN_MUSCLE
    actuator.gaintype = mujoco.mjtGain.mjGAIN_MUSCLE
    actuator.biastype = mujoco.mjtBias.mjBIAS_MUSCLE
    actuator.dynprm[:3] = TIME_CONSTANTS
    # range, force, scale (unused with a force), curve, largest speed, passive force, lengthening force
    prm = [*span, force, 1.0, *CURVE, speed, PASSIVE, LENGTHENING]
    actuator.gainprm[: len(prm)] = prm
    actuator.biasprm[: len(prm)] = prm
    actuator.lengthrange = [lengths.shortest, lengths.longest]
    actuator.ctrllimited = True
    actuator.ctrlrange = [0.0, 1.0]
