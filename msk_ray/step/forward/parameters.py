"""The list of parameters: fields of the model whose values can be arguments of a step, for all worlds or one per world.

mujoco_warp reads such a field as `[worldid % shape[0]]`, so an array with a row per world is valid, if it exists before
launches are recorded. Fields have their names in MjModel.
"""

import copy
import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np
import warp as wp

from msk_ray.step.errors import ConfigError, UnsupportedModelError
from msk_ray.step.forward.geom_pairs import candidate_pairs
from msk_ray.step.forward.model_tree import between_sites, lone_free_bodies
from msk_ray.step.forward.tendon_kinds import between_branches

_OBJ = mujoco.mjtObj


@dataclass(frozen=True)
class Parameter:
    """One field of MjModel."""

    name: str
    """Name in MjModel, such as body_mass or opt.gravity."""
    quaternion: bool = False
    """Whether its elements are unit quaternions, differentiated along rotations in the local frame."""
    in_use: float | None = None
    """Placeholder for elements that MuJoCo drops when zero; None if it drops none."""

    @property
    def field(self) -> str:
        """Name without its section."""
        return self.name.rpartition(".")[2]

    @property
    def section(self) -> str:
        """`opt`, or empty."""
        return self.name.rpartition(".")[0]

    def value(self, mjm: mujoco.MjModel) -> np.ndarray:
        """The field of a model, float64, in MjModel's shape; for actuators (nu, ...)."""
        return np.asarray(attrgetter(self.name)(mjm), dtype=np.float64)

    def array(self, model: Any) -> wp.array:
        """The array of a mujoco_warp.Model."""
        return attrgetter(self.name)(model)


PARAMETERS: dict[str, Parameter] = {
    p.name: p
    for p in (
        *(Parameter(n) for n in ("body_mass", "body_inertia", "body_ipos")),
        Parameter("body_iquat", quaternion=True),
        *(Parameter(n) for n in ("opt.gravity", "opt.timestep")),
        *(Parameter(n) for n in ("dof_damping", "dof_armature")),
        Parameter("jnt_stiffness", in_use=1.0),
        Parameter("qpos_spring"),
        Parameter("dof_frictionloss", in_use=1.0),
        *(Parameter(n) for n in ("dof_solref", "dof_solimp", "jnt_range", "jnt_solref", "jnt_solimp")),
        *(Parameter(n) for n in ("geom_pos", "geom_size")),
        Parameter("geom_quat", quaternion=True),
        *(Parameter(n) for n in ("geom_friction", "geom_solref", "geom_solimp")),
        *(Parameter(n) for n in ("pair_friction", "pair_solref", "pair_solreffriction", "pair_solimp")),
        *(Parameter(n) for n in ("actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_dynprm")),
        *(Parameter(n, in_use=1.0) for n in ("tendon_stiffness", "tendon_damping", "tendon_frictionloss")),
        *(Parameter(n) for n in ("tendon_lengthspring", "tendon_range", "tendon_solref_lim", "tendon_solimp_lim")),
        *(Parameter(n) for n in ("tendon_solref_fri", "tendon_solimp_fri", "site_pos")),
    )
}
"""Every possible parameter."""

DERIVED = {"body_mass": ("body_subtreemass",), "geom_size": ("geom_rbound", "geom_aabb")}
"""Fields computed from a parameter's value: subtree masses, and bounding volumes for collisions."""


def names_of(mjm: mujoco.MjModel) -> list[str]:
    """Names of the parameters that can be varied in a model."""
    return [name for name, p in PARAMETERS.items() if p.value(mjm).size and not _obstacle(mjm, name)]


def check_names(mjm: mujoco.MjModel, names: Iterable[str]) -> None:
    """Raise unless every name is a parameter that can be varied in the model.

    Raises:
        ConfigError: unknown parameter, or the model has no such elements.
        UnsupportedModelError: the model uses something with which the parameter cannot be varied.
    """
    for name in names:
        parameter = PARAMETERS.get(name)
        if parameter is None:
            near = difflib.get_close_matches(name, PARAMETERS, 1, cutoff=0.5)
            hint = f"did you mean {near[0]}?" if near else f"write one of {', '.join(PARAMETERS)}"
            raise ConfigError(f"no parameter {name!r}: {hint}")
        if not parameter.value(mjm).size:
            raise ConfigError(f"the model has no {name} that could be a parameter")
        obstacle = _obstacle(mjm, name)
        if obstacle:
            raise UnsupportedModelError(f"parameter {name} is not supported: {obstacle}")


def _obstacle(mjm: mujoco.MjModel, name: str) -> str:
    """Why a parameter cannot be varied in a model, and what to write instead; empty if it can."""
    inertial = name in ("body_mass", "body_inertia", "body_ipos", "body_iquat")
    if inertial and (mjm.opt.density or mjm.opt.viscosity):
        return "the drag of a fluid follows the inertia too; set density and viscosity to zero"
    if inertial and mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST and lone_free_bodies(mjm):
        return "implicitfast takes gyroscopic forces of free bodies into its matrix; write integrator='Euler'"
    if name in ("body_ipos", "body_iquat"):
        # MuJoCo stores the inertia of this body's dofs as a diagonal.
        simple = [int(b) for b in np.flatnonzero(mjm.body_simple) if mjm.body_dofnum[b]]
        if simple:
            word = mujoco.mj_id2name(mjm, _OBJ.mjOBJ_BODY, simple[0]) or simple[0]
            return (
                f"the inertia of body {word} has no room for terms off its diagonal; shift its <inertial pos> by a "
                "micrometre from the body's origin"
            )
    if name == "opt.timestep" and mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return "RK4 has a time step at every stage; write integrator='Euler' or 'implicitfast'"
    if name == "actuator_gear" and np.any(between_sites(mjm)):
        return "the gear of an actuator between two sites has no gradient; put it on a joint or tendon"
    fast = mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if name in ("tendon_damping", "actuator_gainprm", "actuator_biasprm") and fast and between_branches(mjm).any():
        return "implicitfast drops slopes of dampers and servos on tendons between branches; write integrator='Euler'"
    if name == "pair_solreffriction":
        without = np.flatnonzero(~np.any(mjm.pair_solreffriction, axis=1))
        if without.size:
            word = mujoco.mj_id2name(mjm, _OBJ.mjOBJ_PAIR, int(without[0])) or without[0]
            return f"pair {word} has none of its own and follows solref; write its solreffriction in the model"
    if name == "site_pos":
        on_site = (mjm.actuator_trntype == int(mujoco.mjtTrn.mjTRN_SITE)).any() or between_sites(mjm).any()
        if on_site or (mjm.eq_objtype == int(_OBJ.mjOBJ_SITE)).any():
            return "only sites on the paths of tendons can move; put the site of an actuator or equality on a body"
    if name == "geom_size":
        types = mjm.geom_type[candidate_pairs(mjm, filtered=True)]
        round_pair = (types == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)).any(axis=1)
        if np.any(round_pair & (types != int(mujoco.mjtGeom.mjGEOM_PLANE)).all(axis=1)):
            return "an ellipsoid may touch something other than a plane; make it a capsule, or exclude the pair"
    return ""


def structure(mjm: mujoco.MjModel, names: Iterable[str]) -> mujoco.MjModel:
    """The model with all features that the named parameters may enable, such as springs and friction loss.

    mujoco_warp and the adjoint skip features that a model does not use, judging by this model.
    """
    used = [PARAMETERS[name] for name in names if PARAMETERS[name].in_use is not None]
    if not used:
        return mjm
    out = copy.copy(mjm)
    for parameter in used:
        values = attrgetter(parameter.name)(out)
        values[values == 0.0] = parameter.in_use
    return out


def open_arrays(mjm: mujoco.MjModel, model: Any, names: Iterable[str], nworld: int) -> None:
    """Give the named arrays of a mujoco_warp.Model one row per world, with the values of `mjm`.

    So do the arrays of `DERIVED`, which are recomputed for each value.
    """
    fields = [field for name in names for field in (name, *DERIVED.get(name, ()))]
    for name in fields:
        section, _, field = name.rpartition(".")
        holder = attrgetter(section)(model) if section else model
        old = getattr(holder, field)
        length = getattr(old.dtype, "_length_", 1)
        shape = (nworld, *old.shape[1:], length) if length > 1 else (nworld, *old.shape[1:])
        rows = np.broadcast_to(np.asarray(attrgetter(name)(mjm), np.float32).reshape(shape[1:]), shape)
        setattr(holder, field, wp.array(np.ascontiguousarray(rows), dtype=old.dtype))
