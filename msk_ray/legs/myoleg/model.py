"""`myoleg`: a muscle-driven leg model that is installed on this machine, or a model file.

`source` finds it. `describe` names the model found, and the trial logs it.
"""

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from msk_ray.config import PhysicsConfig
from msk_ray.envs.options import apply_options
from msk_ray.errors import ConfigError
from msk_ray.legs.gait.body import JOINTS, SIDES, flexion_sign, world_axes
from msk_ray.legs.muscles import smooth_activation
from msk_ray.legs.myoleg.config import MyoLegSettings
from msk_ray.legs.myoleg.source import find_model
from msk_ray.legs.reference import adduction_under, level_toes, people_angles, sway

SUBSTEPS: Final = 10
"""Physics steps of a control step of 20 ms: 2 ms each, as the models' own."""
SMOOTHING: Final = 0.2
"""Width, in excitation, of the blend between activation and deactivation; a hard switch has no slope."""
CYCLE_STATES: Final = 50
"""Initial states over the gait cycle."""
_SINKING: Final = 5e-4
"""Depth to which the lowest point of the standing pose enters the ground [m]."""


def build_myoleg(env: MyoLegSettings, physics: PhysicsConfig) -> mujoco.MjModel:
    """Compile the model found, with this trial's solver settings and, as keyframe `stand`, its standing pose.

    Every muscle's activation is smoothed. In the packages' models, contacts that have no exact gradient are switched
    off: those with scenery other than the plane (height fields, a pedestal) and those between meshes.

    Raises:
        ConfigError: as for `find_model`, or the model has no free root joint or no `hip_flexion_r`.
    """
    source = find_model(env.model, env.source)
    spec = source.load()
    apply_options(spec, physics.in_substeps(SUBSTEPS), env.control_timestep)
    smooth_activation(spec, SMOOTHING)
    if source.package != "file":
        _keep_plane_contacts(spec)
    for key in list(spec.keys):
        spec.delete(key)
    spec.nkey = 0  # a size asked for in the file would add nameless keys before ours
    model = spec.compile()
    joints = {model.joint(j).name for j in range(model.njnt)}
    if not joints >= {"hip_flexion_r", "hip_flexion_l"} or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise ConfigError(f"env.model: {source.name} has no free joint first, or no joints hip_flexion_r and _l")
    spec.add_key(name="stand", qpos=standing_pose(model))
    return spec.compile()


def _keep_plane_contacts(spec: mujoco.MjSpec) -> None:
    for geom in spec.worldbody.geoms:
        if geom.type != mujoco.mjtGeom.mjGEOM_PLANE:
            geom.contype = geom.conaffinity = 0
    meshes = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH]
    for geom in meshes:
        geom.conaffinity = 0  # its contype still meets the plane's conaffinity
    names = {geom.name for geom in meshes}
    for pair in list(spec.pairs):
        if {pair.geomname1, pair.geomname2} <= names:
            spec.delete(pair)


def ground_height(model: mujoco.MjModel) -> float:
    """Height of the world's highest plane [m].

    Raises:
        ConfigError: it has none.
    """
    planes = (model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)) & (model.geom_bodyid == 0)
    if not planes.any():
        raise ConfigError("env.model: there is no ground plane; add one to the model's worldbody")
    return float(model.geom_pos[planes, 2].max())


class Couplings:
    """Joint equalities q₁ = q₁⁰ + Σ c_k (q₂ - q₂⁰)^k of a model.

    Attributes:
        dependent, driving: qpos addresses of q₁ and q₂, shape (E,); `fixed` ones are driven by their own reference.
        dependent_dofs, driving_dofs: the same among velocities.
        coefficients: c, shape (E, 5).
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        joints = np.flatnonzero((model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & (model.eq_active0 != 0))
        first, second = model.eq_obj1id[joints], model.eq_obj2id[joints]
        # A joint held at a constant has no partner; itself with no slope says the same.
        held = second < 0
        second = np.where(held, first, second)
        self.coefficients: NDArray[np.float64] = model.eq_data[joints, :5].copy()
        self.coefficients[held, 1:] = 0.0
        self.dependent, self.driving = model.jnt_qposadr[first], model.jnt_qposadr[second]
        self.dependent_dofs, self.driving_dofs = model.jnt_dofadr[first], model.jnt_dofadr[second]
        self.reference, self.driving_reference = model.qpos0[self.dependent], model.qpos0[self.driving]
        self.joints = {int(j) for j in first}

    def satisfied(self, qpos: NDArray[np.float64]) -> NDArray[np.float64]:
        """qpos (nq,) with every dependent joint set by its equality."""
        out = qpos.copy()
        offset = out[self.driving] - self.driving_reference
        out[self.dependent] = self.reference + sum(self.coefficients[:, k] * offset**k for k in range(5))
        return out


def standing_pose(model: mujoco.MjModel) -> NDArray[np.float64]:
    """The reference configuration with its equalities satisfied, lowered until it touches the ground.

    Raises:
        ConfigError: it touches nothing over two metres, or stands on scenery, from which it could only walk off.
    """
    pose = lowered(model, Couplings(model).satisfied(model.qpos0))
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    data.qpos[2] -= 2.0 * _SINKING
    mujoco.mj_fwdPosition(model, data)
    for geom in data.contact.geom.ravel():
        if model.geom_bodyid[geom] == 0 and model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE:
            name = model.geom(geom).name or f"number {geom}"
            raise ConfigError(
                f"env.model: the standing pose stands on geom {name}, which ends; remove it from worldbody, or write "
                "contype 0 and conaffinity 0, so that the legs stand on the plane"
            )
    return pose


def lowered(model: mujoco.MjModel, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """A pose (nq,) at the height at which it touches the ground.

    Raises:
        ConfigError: it touches nothing over two metres.
    """
    data, pose = mujoco.MjData(model), pose.copy()

    def touches(height: float) -> bool:
        data.qpos[:] = pose
        data.qpos[2] = height
        mujoco.mj_fwdPosition(model, data)
        on_ground = np.any(model.geom_bodyid[data.contact.geom] == 0, axis=1)
        return bool(data.contact.dist[on_ground].min(initial=0.0) < -_SINKING)

    above, below = float(pose[2]) + 1.0, float(pose[2]) - 1.0
    if touches(above) or not touches(below):
        raise ConfigError("env.model: the standing pose meets no ground between one metre above and below its height")
    for _ in range(40):
        middle = (above + below) / 2.0
        above, below = (above, middle) if touches(middle) else (middle, below)
    pose[2] = above
    return pose


def cycle_states(model: mujoco.MjModel, swaying: bool = False) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """qpos (N, nq) and qvel (N, nv) of legs that take one stride a second on the spot, at N equal distances of the gait
    cycle of people, from the right foot's strike on.

    Hips, knees and ankles are those of `people_angles`, toes on the ground are level, and everything else is as in
    standing. The lowest point touches the ground. If `swaying`, the pelvis moves to the side between the feet as an
    inverted pendulum does (`sway`), and the hips adduct so that the feet stay on their lines.
    """
    toes, couplings = level_toes(), Couplings(model)

    def posed(toe_sign: float, phases: list[int]) -> NDArray[np.float64]:
        poses = np.repeat(model.key("stand").qpos[None], len(phases), axis=0)
        for side, ahead in (("r", 0), ("l", 50)):
            at = [(phase + ahead) % 100 for phase in phases]
            angles = {
                name: flexion_sign(model, name) * a[at]
                for name, a in zip(JOINTS.values(), people_angles(), strict=True)
            }
            for joint, values in (angles | {"mtp_angle": toe_sign * toes[at]}).items():
                entry = model.joint(f"{joint}_{side}")
                poses[:, entry.qposadr[0]] = values.clip(*entry.range)
        return np.stack([lowered(model, couplings.satisfied(pose)) for pose in poses])

    # Toes that bend the wrong way lift the body when the heel has left the ground.
    toe_sign = min((1.0, -1.0), key=lambda sign: float(posed(sign, [54])[0, 2]))
    phases = list(range(0, 100, 100 // CYCLE_STATES))
    qpos = posed(toe_sign, phases)
    if swaying:
        qpos = _swayed(model, qpos, phases)
    around = np.concatenate((qpos[-1:], qpos, qpos[:1]))
    slopes = (around[2:] - around[:-2]) * (CYCLE_STATES / 2.0)
    qvel = np.zeros((CYCLE_STATES, model.nv))
    qvel[:, :3] = slopes[:, :3]
    # Behind the free root, every joint is a hinge or a slide.
    qvel[:, model.jnt_dofadr[1:]] = slopes[:, model.jnt_qposadr[1:]]
    return qpos, qvel


def _swayed(model: mujoco.MjModel, poses: NDArray[np.float64], phases: list[int]) -> NDArray[np.float64]:
    """Poses (N, nq) at these phases [% of the cycle] with the pelvis moved to the side and the feet on their lines."""
    data, couplings, left = mujoco.MjData(model), Couplings(model), world_axes(model)[1]
    data.qpos[:] = model.key("stand").qpos
    mujoco.mj_kinematics(model, data)
    apart = float((data.body("calcn_l").xpos - data.body("calcn_r").xpos) @ left)
    aside = sway(apart / 2.0, float(model.key("stand").qpos[2]) - ground_height(model))[phases]
    moved = []
    for pose, right in zip(poses.copy(), aside, strict=True):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for side in SIDES:
            joint = model.joint(f"hip_adduction_{side}")
            back = adduction_under(model, data, side, right, left)
            pose[joint.qposadr[0]] = np.clip(pose[joint.qposadr[0]] + back, *joint.range)
        pose[:3] -= right * left
        moved.append(lowered(model, couplings.satisfied(pose)))
    return np.stack(moved)
