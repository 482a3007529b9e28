"""Contact with the floor and joint limits of the bodies of DiffRL's suite, hard or as in dflex.

dflex (Xu et al. 2022, arXiv:2204.07137; `eval_rigid_contacts_art` and `jcalc_tau` in `dflex/dflex/sim.py` of
github.com/NVlabs/DiffRL) pushes a point at depth c out of the floor with k_e·c, damps its approach with k_d·c·|v|, and
slows it along the floor with k_f·|v|, up to μ·k_e·c. A joint beyond its range is pushed back by k_l per rad; its damper
d_l acts at every angle.

MuJoCo's constraint force is D (d·k·c − b·v − a), with D = d / ((1 − d) A) for the impedance d, the inverse inertia A
that MuJoCo assumes for the row, and the acceleration a along it (see "constraint model" in its documentation). A
depends on the body, so that every pair of a geom with the floor has its own k = k_e / (d D), and its own dampings
k_d·(1 cm) / D and k_f / D, and every joint its own k = k_l / (d D). A small impedance leaves little of the inertia D;
what remains are dflex's springs and dampers, but for the damping of the approach, which here neither grows with depth
nor ends when the point leaves. Light bodies have as much impedance as keeps their friction stable at the time step.
`lab/benchmarks/dflex_floor.py` scores policies under both.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from msk_ray.config import PhysicsConfig
from msk_ray.config.physics import Vec2, Vec5
from msk_ray.config.sections import EnvSettings
from msk_ray.envs.options import add_grid, add_sky, apply_options

_IMPEDANCE = 0.2
"""The smallest."""
_DEPTH = 0.01
"""Depth [m] at which the damping of the approach is that of dflex."""


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
    damping: float
    """k_d of a contact, per depth [N s/m²]."""
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
            sliding = contacts.friction
        pair.friction = [sliding, sliding, 0.005, 0.0001, 0.0001]
    if isinstance(contacts, SpringContacts):
        match_springs(spec, contacts)
    override(spec, physics)
    return spec.compile()


def _add_floor(spec: mujoco.MjSpec) -> None:
    grid = add_grid(spec)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(
        name="floor", type=plane, size=[0, 0, 1], material=grid, contype=0, conaffinity=0, pos=[0, 0, 0]
    )


def _actuated(spec: mujoco.MjSpec) -> list[mujoco.MjsJoint]:
    driven = {actuator.target for actuator in spec.actuators}
    return [joint for joint in spec.joints if joint.name in driven]


def match_springs(spec: mujoco.MjSpec, contacts: SpringContacts) -> None:
    """Give every pair, and the limits of actuated joints, the springs and dampers of `contacts` in place."""
    model = spec.compile()
    elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    for pair in spec.pairs:
        mobility = model.body_invweight0[model.geom(pair.geomname2).bodyid[0], 0]  # A
        # MuJoCo holds friction's time constant, 2 / ((1 − d) k_f A), above two time steps.
        impedance = max(_IMPEDANCE, 1.0 - 1.0 / (model.opt.timestep * contacts.friction_damping * mobility))
        inverse = (1.0 - impedance) / impedance * mobility  # 1 / D
        # Its references are b = 2 / (d τ), and k = 1 / (d τ r)² = (b / 2r)² for the damping ratio r.
        stiffness, damping = contacts.stiffness * inverse / impedance, _DEPTH * contacts.damping * inverse
        pair.solref = [2.0 / (impedance * damping), damping / (2.0 * np.sqrt(stiffness))]
        pair.solimp = _constant(impedance)
        if elliptic:  # the pyramid has no friction directions of its own
            pair.solreffriction = [2.0 / (impedance * contacts.friction_damping * inverse), 1.0]
    for joint in _actuated(spec):
        inverse = (1.0 - _IMPEDANCE) / _IMPEDANCE * model.dof_invweight0[model.joint(joint.name).dofadr[0]]
        # Two numbers that are not positive are -k d² and -b d; the joint has dflex's damper already.
        joint.solref_limit = [-contacts.limit_stiffness * inverse * _IMPEDANCE, 0.0]
        joint.solimp_limit = _constant(_IMPEDANCE)


def _constant(impedance: float) -> list[float]:
    """An impedance that does not depend on the depth."""
    return [impedance, impedance, 0.01, 0.5, 2.0]


def override(spec: mujoco.MjSpec, physics: PhysicsConfig) -> None:
    """Set what `physics` overrides of pairs."""
    for pair in spec.pairs:
        if physics.solref is not None:
            pair.solref = list(physics.solref)
        if physics.solimp is not None:
            pair.solimp = list(physics.solimp)
        if physics.solreffriction is not None:
            pair.solreffriction = list(physics.solreffriction)
