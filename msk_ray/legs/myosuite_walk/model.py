"""The model of MyoSuite's walking task: legs with 80 muscles under a rigid torso, from the package's own file."""

from typing import Final

import mujoco

from msk_ray.config import PhysicsConfig
from msk_ray.envs.options import apply_options
from msk_ray.errors import ConfigError
from msk_ray.legs.muscles import smooth_activation
from msk_ray.legs.myoleg.source import spec_of_file
from msk_ray.legs.myosuite_walk.config import MyoSuiteWalkSettings
from msk_ray.legs.myosuite_walk.source import INSTALL, find_file

SUBSTEPS: Final = 10
"""Physics steps of an env step: MyoSuite's frame_skip."""
KEYFRAMES: Final = ("stand", "crouch", "right_knee_flexed", "left_knee_flexed")
"""Our names of the model's keyframes, in its order."""
BODIES: Final = ("torso", "pelvis", "talus_l", "talus_r")
"""Bodies that the observation measures."""
HINGES: Final = tuple(f"hip_{angle}_{side}" for angle in ("flexion", "adduction", "rotation") for side in "lr")
"""Joints that the reward measures."""


def build_myosuite_walk(env: MyoSuiteWalkSettings, physics: PhysicsConfig) -> mujoco.MjModel:
    """Compile the model with this trial's solver settings.

    Two things are changed: activation is smoothed by `env.smoothing`, and the height field is left out, which MyoSuite
    moves to 10 m below the ground in this task.

    Raises:
        ConfigError: as for `find_file`, or the file holds another model.
    """
    path = find_file(env.model)
    spec = spec_of_file(path)
    apply_options(spec, physics.in_substeps(SUBSTEPS), env.control_timestep)
    smooth_activation(spec, env.smoothing)
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_HFIELD:
            spec.delete(geom)
    if len(spec.keys) != len(KEYFRAMES):
        raise ConfigError(
            f"env.model: {path} has {len(spec.keys)} keyframes, not MyoSuite's {len(KEYFRAMES)}: {INSTALL}"
        )
    for key, name in zip(spec.keys, KEYFRAMES, strict=True):
        key.name = name
    model = spec.compile()
    bodies = {model.body(b).name for b in range(model.nbody)}
    joints = {model.joint(j).name for j in range(model.njnt)}
    missing = [*(set(BODIES) - bodies), *(set(HINGES) - joints)]
    if missing or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        lacks = f"no {min(missing)}" if missing else "no free joint first"
        raise ConfigError(f"env.model: {path} has {lacks}: {INSTALL}")
    return model
