"""The model of MyoSuite's walking task: legs with 80 muscles under a rigid torso, from the package's own file."""

from pathlib import Path
from typing import Final

import mujoco

from msk_ray.config import PhysicsConfig
from msk_ray.envs.options import apply_options
from msk_ray.errors import ConfigError
from msk_ray.legs.myoleg.model import INSTALL_OF, package_folder, spec_of_file
from msk_ray.legs.myosuite_walk.config import MyoSuiteWalkSettings

VERSION: Final = "2.12"
"""Version of MyoSuite whose task this is."""
INSTALL: Final = f"{INSTALL_OF['myosuite2']}, or set env.model to the path of its myolegs.xml"
SUBSTEPS: Final = 10
"""Physics steps of an env step: MyoSuite's frame_skip."""
KEYFRAMES: Final = ("stand", "crouch", "right_knee_flexed", "left_knee_flexed")
"""Our names of the model's keyframes, in its order."""
BODIES: Final = ("torso", "pelvis", "talus_l", "talus_r")
"""Bodies that the observation measures."""
HINGES: Final = tuple(f"hip_{angle}_{side}" for angle in ("flexion", "adduction", "rotation") for side in "lr")
"""Joints that the reward measures."""
_FILE: Final = Path("simhive/myo_sim/leg/myolegs.xml")


def find_file(model: str | None) -> Path:
    """The model's file.

    Raises:
        ConfigError: there is no such file, or no MyoSuite of this version.
    """
    if model is not None:
        path = Path(model)
        if not path.is_file():
            raise ConfigError(f"env.model: no file {model}; {INSTALL}")
        return path
    found = package_folder("myosuite")
    if found is None:
        raise ConfigError(f"env.model: MyoSuite {VERSION} is not installed: {INSTALL}")
    folder, version = found
    if not version.startswith(f"{VERSION}.") or not (folder / _FILE).is_file():
        raise ConfigError(f"env.model: this is the task of MyoSuite {VERSION}, but {version} is installed: {INSTALL}")
    return folder / _FILE


def build_myosuite_walk(env: MyoSuiteWalkSettings, physics: PhysicsConfig) -> mujoco.MjModel:
    """Compile the model with this trial's solver settings.

    Two things are changed: activation is smoothed by `env.smoothing`, and the height field is left out, which MyoSuite
    moves to 10 m below the ground in this task.

    Raises:
        ConfigError: as for `find_file`, or the file holds another model.
    """
    path = find_file(env.model)
    spec = spec_of_file(path)
    if physics.substeps is None and physics.timestep is None:
        physics = physics.model_copy(update={"substeps": SUBSTEPS})
    apply_options(spec, physics, env.control_timestep)
    for actuator in spec.actuators:
        if actuator.dyntype == mujoco.mjtDyn.mjDYN_MUSCLE:
            actuator.dynprm[2] = env.smoothing
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
