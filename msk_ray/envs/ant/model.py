"""The ant: a sphere on four two-jointed legs, in four named physics.

Geometry is the classic ant's (Schulman et al. 2016, "High-dimensional continuous control using generalized advantage
estimation"): torso radius 0.25 m, capsule legs of radius 0.08 m.
"""

from dataclasses import dataclass, replace
from itertools import product

import mujoco
import numpy as np

from msk_ray.config import PhysicsConfig
from msk_ray.envs.ant.config import AntSettings
from msk_ray.envs.floor import SpringContacts, match_springs, override
from msk_ray.envs.options import add_grid, add_sky, apply_options

STAND_HEIGHT = 0.75
STAND_JOINTS = (0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0)
"""Hip and ankle angle [rad] of each leg in the standing pose."""


@dataclass(frozen=True)
class AntPhysics:
    """The values of a named physics of the ant; units as in `PhysicsConfig`."""

    cone: str
    solref: tuple[float, float]
    solimp: tuple[float, float, float, float, float]
    friction: float
    solreffriction: tuple[float, float]
    margin: float
    joint_damping: float
    armature: float
    solref_limit: tuple[float, float]
    solimp_limit: tuple[float, float, float, float, float]
    hip_range: tuple[float, float]
    gear: float
    density: float
    springs: SpringContacts | None = None
    """dflex's contacts and limits, in place of those above."""


# Masses, joints and motors of `matched` are those of the dflex ant, with which SHAC's reference results were obtained.
# Its contacts and limits imitate dflex's, with an impedance of 0.9, which resists acceleration too; policies of one do
# not run on the other (lab/ant.md).
_MATCHED = AntPhysics(
    cone="elliptic",
    solref=(0.065, 1.0),
    solimp=(0.9, 0.9, 0.01, 0.5, 2.0),
    friction=0.75,
    solreffriction=(0.19, 1.0),
    margin=0.0,
    joint_damping=11.0,
    armature=0.05,
    solref_limit=(-122.0, -1.2),
    solimp_limit=(0.9, 0.9, 0.01, 0.5, 2.0),
    hip_range=(-40.0, 40.0),
    gear=200.0,
    density=1000.0,
)

VARIANTS = {
    # MuJoCo's and Gymnasium's ant as published: light, stiff, with contacts at MuJoCo's default hardness.
    "published": AntPhysics(
        cone="pyramidal",
        solref=(0.02, 1.0),
        solimp=(0.9, 0.95, 0.001, 0.5, 2.0),
        friction=1.0,
        solreffriction=(0.0, 0.0),
        margin=0.01,
        joint_damping=1.0,
        armature=1.0,
        solref_limit=(0.02, 1.0),
        solimp_limit=(0.9, 0.95, 0.001, 0.5, 2.0),
        hip_range=(-30.0, 30.0),
        gear=150.0,
        density=5.0,
    ),
    "matched": _MATCHED,
    "matched_hard_friction": replace(_MATCHED, solreffriction=(0.0, 0.0)),
    # The constants of `envs/ant.py` of github.com/NVlabs/DiffRL, as those of the other bodies in `envs/floor.py`.
    "matched_springs": replace(
        _MATCHED, springs=SpringContacts(stiffness=4e4, damping=1e4, friction_damping=3e3, friction=0.75)
    ),
}


def build_ant(env: AntSettings, physics: PhysicsConfig) -> mujoco.MjModel:
    """The model that `ant_spec` describes."""
    return ant_spec(env, physics).compile()


def ant_spec(env: AntSettings, physics: PhysicsConfig) -> mujoco.MjSpec:
    """Free torso and 8 hinges (hip, ankle of the legs at +x+y, -x+y, -x-y, +x-y), 8 motors in the same order.

    All contacts are explicit pairs of a geom with the floor, so that friction can be softened independently.
    """
    p = VARIANTS[physics.variant or "matched"]
    cone = physics.cone or p.cone
    spec = mujoco.MjSpec()
    spec.modelname = "ant"
    spec.compiler.degree = True
    apply_options(spec, physics.model_copy(update={"cone": cone}), env.control_timestep)
    add_sky(spec)
    world = spec.worldbody
    grid = add_grid(spec)
    ground = {"contype": 0, "conaffinity": 0}
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], material=grid, **ground)

    torso = world.add_body(name="torso", pos=[0, 0, STAND_HEIGHT])
    # Camera and light follow: shadows are cast only within a few metres of the light.
    along = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    torso.add_camera(name="track", mode=along, pos=[0, -4, 1.2], xyaxes=[1, 0, 0, 0, 0.3, 1])
    torso.add_light(mode=along, pos=[0, 0, 6], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    torso.add_freejoint(name="root")
    body_look = {"density": p.density, "rgba": [0.8, 0.6, 0.3, 1], **ground}
    limb_look = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [0.08, 0, 0], **body_look}
    names = ["torso"]
    torso.add_geom(name="torso", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.25, 0, 0], **body_look)
    joint = {
        "type": mujoco.mjtJoint.mjJNT_HINGE,
        "damping": p.joint_damping,
        "armature": p.armature,
        "limited": True,
        "solref_limit": list(p.solref_limit),
        "solimp_limit": list(p.solimp_limit),
    }
    for leg, (x, y) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)], start=1):
        names += [f"aux_{leg}", f"hip_{leg}", f"ankle_{leg}"]
        torso.add_geom(name=f"aux_{leg}", fromto=[0, 0, 0, 0.2 * x, 0.2 * y, 0], **limb_look)
        upper = torso.add_body(name=f"upper_{leg}", pos=[0.2 * x, 0.2 * y, 0])
        upper.add_joint(name=f"hip_{leg}", axis=[0, 0, 1], range=list(p.hip_range), **joint)
        upper.add_geom(name=f"hip_{leg}", fromto=[0, 0, 0, 0.2 * x, 0.2 * y, 0], **limb_look)
        lower = upper.add_body(name=f"lower_{leg}", pos=[0.2 * x, 0.2 * y, 0])
        # The knee axis is horizontal and across the leg; its sign makes legs 1 and 4 bend at positive angles.
        axis, bend = ([-1, 1, 0], 1) if x * y > 0 else ([1, 1, 0], -1)
        bend *= 1 if y > 0 else -1
        bent = (30.0, 100.0) if bend > 0 else (-100.0, -30.0)
        lower.add_joint(name=f"ankle_{leg}", axis=axis, range=list(bent), **joint)
        lower.add_geom(name=f"ankle_{leg}", fromto=[0, 0, 0, 0.4 * x, 0.4 * y, 0], **limb_look)
    for leg, name in product(range(1, 5), ("hip", "ankle")):
        motor = spec.add_actuator(name=f"{name}_{leg}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=f"{name}_{leg}")
        motor.gear[0] = p.gear
        motor.ctrllimited = True
        motor.ctrlrange = [-1.0, 1.0]
    for name in names:
        pair = spec.add_pair(geomname1="floor", geomname2=name, condim=3, margin=p.margin)
        pair.solref = list(p.solref)
        pair.solimp = list(p.solimp)
        pair.friction = [p.friction, p.friction, 0.005, 0.0001, 0.0001]
        if cone == "elliptic":  # the pyramid has no friction directions of its own
            pair.solreffriction = list(p.solreffriction)
    if p.springs is not None:
        match_springs(spec, p.springs)
    override(spec, physics)
    stand = np.concatenate([[0, 0, STAND_HEIGHT, 1, 0, 0, 0], STAND_JOINTS])
    spec.add_key(name="stand", qpos=stand)
    return spec
