"""Contact with the floor and joint limits of the bodies of DiffRL's suite, hard or as in dflex.

dflex (Xu et al. 2022, arXiv:2204.07137; `dflex/dflex/sim.py` of github.com/NVlabs/DiffRL, `eval_rigid_contacts_art` and
`jcalc_tau`) pushes a point at depth c out of the floor with k_e·c, and slows it along the floor with k_f·|v|, up to
μ·k_e·c. A joint beyond its range is pushed back by k_l per rad; its damper d_l acts at every angle.

MuJoCo's constraint force in place (no acceleration along the row) is D (d·k·c − b·v), with D = d / ((1 − d) A) for the
impedance d and the inverse inertia A that MuJoCo assumes for the row (see "constraint model" in its documentation). A
depends on the body, so that every pair of a geom with the floor has its own k = k_e / (d D) and friction damping
b = k_f / D, and every joint its own k = k_l / (d D). Then the floor gives way under a weight as dflex's does, and
friction is viscous up to the same speed. What differs: contact is critically damped, where dflex damps in proportion to
the depth; a limit damps by d_l once more; and an impedance of 0.9 resists acceleration too.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from msk_ray.config import PhysicsConfig
from msk_ray.config.physics import Vec2, Vec5
from msk_ray.config.sections import EnvSettings
from msk_ray.envs.options import add_sky, apply_options

_IMPEDANCE = 0.9
_CONSTANT: Vec5 = (_IMPEDANCE, _IMPEDANCE, 0.01, 0.5, 2.0)
"""An impedance that does not depend on the depth."""


@dataclass(frozen=True)
class HardContacts:
    """MuJoCo's contact of every geom with the floor; joint limits are those of the model's file."""

    solref: Vec2
    solimp: Vec5
    friction: float
    """Sliding friction coefficient."""
    frictions: Mapping[str, float] = field(default_factory=dict)
    """Other coefficients, by the geom's name."""
    margin: float = 0.0
    """Distance at which a contact begins [m]."""
    cone: str = "pyramidal"


@dataclass(frozen=True)
class SpringContacts:
    """Springs and dampers of dflex."""

    stiffness: float
    """k_e of a contact [N/m]."""
    friction_damping: float
    """k_f of a contact [N s/m]."""
    friction: float
    """μ."""
    limit_stiffness: float = 1e3
    """k_l of a joint's limits [N m/rad]."""
    limit_damping: float = 10.0
    """d_l of a joint, inside its range too [N m s/rad]."""
    cone: str = "elliptic"


def compile_on_floor(
    spec: mujoco.MjSpec, env: EnvSettings, physics: PhysicsConfig, contacts: HardContacts | SpringContacts
) -> mujoco.MjModel:
    """Compile `spec` with a floor, which every named geom but no two of them can touch, and what `physics` overrides.

    Contacts are explicit pairs of a geom with the floor, so that their friction can be softened on its own.
    """
    apply_options(spec, physics.model_copy(update={"cone": physics.cone or contacts.cone}), env.control_timestep)
    add_sky(spec)
    geoms = [geom.name for geom in spec.geoms]
    _add_floor(spec)
    for name in geoms:
        pair = spec.add_pair(name=name, geomname1="floor", geomname2=name, condim=3)
        if isinstance(contacts, HardContacts):
            pair.margin, pair.solref, pair.solimp = contacts.margin, list(contacts.solref), list(contacts.solimp)
            sliding = contacts.frictions.get(name, contacts.friction)
        else:
            pair.solimp, sliding = list(_CONSTANT), contacts.friction
        pair.friction = [sliding, sliding, 0.005, 0.0001, 0.0001]
    for joint in _actuated(spec):
        if isinstance(contacts, SpringContacts):
            joint.solimp_limit = list(_CONSTANT)
        if physics.joint_damping is not None:
            joint.damping[0] = physics.joint_damping
        if physics.armature is not None:
            joint.armature = physics.armature
    if isinstance(contacts, SpringContacts):
        _match(spec, contacts)
    _override(spec, physics)
    return spec.compile()


def _add_floor(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="grid",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.25, 0.3, 0.35],
        rgb2=[0.32, 0.38, 0.44],
        width=256,
        height=256,
    )
    material = spec.add_material(name="grid", texrepeat=[1, 1], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(
        name="floor", type=plane, size=[0, 0, 1], material="grid", contype=0, conaffinity=0, pos=[0, 0, 0]
    )


def _actuated(spec: mujoco.MjSpec) -> list[mujoco.MjsJoint]:
    driven = {actuator.target for actuator in spec.actuators}
    return [joint for joint in spec.joints if joint.name in driven]


def _match(spec: mujoco.MjSpec, contacts: SpringContacts) -> None:
    """Give every pair and limit the reference that has the springs and dampers of `contacts` in place."""
    model = spec.compile()
    slack = (1.0 - _IMPEDANCE) / _IMPEDANCE  # 1 / D = slack · A
    elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    for pair in spec.pairs:
        inverse = slack * model.body_invweight0[model.geom(pair.geomname2).bodyid[0], 0]
        # MuJoCo's references: k = 1 / (d τ)² and b = 2 / (d τ) for a damping ratio of one.
        pair.solref = [1.0 / np.sqrt(_IMPEDANCE * contacts.stiffness * inverse), 1.0]
        if elliptic:  # the pyramid has no friction directions of its own
            pair.solreffriction = [2.0 / (_IMPEDANCE * contacts.friction_damping * inverse), 1.0]
    for joint in _actuated(spec):
        inverse = slack * model.dof_invweight0[model.joint(joint.name).dofadr[0]]
        # Two negative numbers are -k d² and -b d.
        stiffness, damping = contacts.limit_stiffness * inverse, contacts.limit_damping * inverse
        joint.solref_limit = [-stiffness * _IMPEDANCE, -damping * _IMPEDANCE]


def _override(spec: mujoco.MjSpec, physics: PhysicsConfig) -> None:
    for pair in spec.pairs:
        if physics.solref is not None:
            pair.solref = list(physics.solref)
        if physics.solimp is not None:
            pair.solimp = list(physics.solimp)
        if physics.solreffriction is not None:
            pair.solreffriction = list(physics.solreffriction)
        if physics.friction is not None:
            pair.friction = [physics.friction, physics.friction, 0.005, 0.0001, 0.0001]
    for joint in _actuated(spec):
        if physics.solref_limit is not None:
            joint.solref_limit = list(physics.solref_limit)
        if physics.solimp_limit is not None:
            joint.solimp_limit = list(physics.solimp_limit)
    for actuator in spec.actuators:
        if physics.gear is not None:
            actuator.gear[0] = physics.gear
