"""Keyframes of `myoleg26`: standing, and just after either foot struck the ground at walking speed.

Angles are chosen; heights and the trailing knee are solved for, so that the soles touch the ground and no joint is
beyond its range. Walking velocities are those of a pelvis moving forward over feet that do not slip.
"""

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from msk_ray.legs.myoleg26.tables import OUTLINE
from msk_ray.legs.reference import adduction_under, level_toes, people_angles, sway

WALKING_SPEED: Final = 1.25
"""Speed of the walking keyframes [m/s]."""
REST_ACTIVATION: Final = 0.02
"""Activation of every muscle in the walking keyframes, and the smallest in standing: a little tension stiffens
joints."""
_LEFT: Final = np.array([0.0, 1.0, 0.0])
_LEAST_EFFORT: Final = 1e-4
_SOLVER_STEPS: Final = 3000
_PRESSED: Final = 5e-4
"""Depth to which the lowest point of a sole enters the ground [m], so that there is contact from the first step."""

STAND: Final = {"pelvis_tilt": -0.07, "hip_flexion": 0.05, "knee_angle": -0.1, "ankle_angle": 0.12}
"""Standing [rad], feet flat, knees a little bent: the centre of mass is over the middle of the feet."""
_TRUNK: Final = {"pelvis_tilt": -0.05}
# Angles about heel strike of level walking (Winter 1991, "The biomechanics and motor control of human gait"): hip
# flexed by 20° in front and extended by 10° behind, leading knee nearly straight, trailing heel off the ground.
_LEADING: Final = {"hip_flexion": 0.4, "knee_angle": -0.08, "ankle_angle": -0.02}
_TRAILING: Final = {"hip_flexion": -0.15, "knee_angle": -0.3, "ankle_angle": 0.1}


def add_keyframes(spec: mujoco.MjSpec) -> None:
    """Add stand, walk_left and walk_right (the foot that has struck) to a spec that already has its muscles."""
    model = spec.compile()
    act = np.full(model.na, REST_ACTIVATION)
    ctrl = np.zeros(model.nu)
    ctrl[: model.na] = REST_ACTIVATION
    stand = _posed(model, STAND, {}, {})
    stand.qpos[_address(model, "pelvis_ty")] -= _lowest(model, stand, "rl") + _PRESSED
    held = ctrl.copy()
    held[: model.na] = holding_activations(model, stand.qpos)
    spec.add_key(name="stand", qpos=stand.qpos, act=held[: model.na], ctrl=held)
    for leading, trailing in (("l", "r"), ("r", "l")):
        data = _double_support(model, leading, trailing)
        name = "walk_left" if leading == "l" else "walk_right"
        spec.add_key(name=name, qpos=data.qpos, qvel=_rolling(model, data, leading, trailing), act=act, ctrl=ctrl)


def cycle_states(model: mujoco.MjModel) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """qpos (N, nq) and qvel (N, nv) of legs that take one stride a second on the spot, and act (N, na), at N equal
    distances of the gait cycle of people, from the right foot's strike on.

    Angles are those of `people_angles`. The trunk is upright, toes stay level while their foot is on the ground and
    pitched, and the lowest point of the soles touches the ground. The pelvis sways between the feet (`sway`), whose
    lines stay where they are. The feet are on the spot: add a forward speed.
    """
    hip, knee, ankle = people_angles()[:, :-1]
    count, toes = len(hip), level_toes()[:-1]
    names = ("hip_flexion", "knee_angle", "ankle_angle", "mtp_angle")
    right = np.stack((hip, -knee, ankle, toes))
    legs = {"r": right, "l": np.roll(right, count // 2, axis=1)}
    qpos = np.zeros((count, model.nq))
    upright = _posed(model, {}, {}, {})
    aside = sway(abs(float(upright.body("calcn_r").xpos[1])), float(model.key("stand").qpos[1]))[:-1]
    for k in range(count):
        angles = [dict(zip(names, legs[side][:, k], strict=True)) for side in "rl"]
        data = _posed(model, {"pelvis_tz": aside[k]}, *angles)
        for side, chosen in zip("rl", angles, strict=True):
            chosen["hip_adduction"] = adduction_under(model, data, side, aside[k], _LEFT)
        data = _posed(model, {"pelvis_tz": aside[k]}, *angles)
        qpos[k] = data.qpos
        qpos[k, _address(model, "pelvis_ty")] -= _lowest(model, data, "rl") + _PRESSED
    low, high = model.jnt_range[model.jnt_limited.astype(bool)].T
    limited = model.jnt_qposadr[model.jnt_limited.astype(bool)]
    qpos[:, limited] = qpos[:, limited].clip(low, high)
    around = np.concatenate((qpos[-1:], qpos, qpos[:1]))
    qvel = (around[2:] - around[:-2]) * (count / 2.0)
    return qpos, qvel, np.full((count, model.na), REST_ACTIVATION)


def holding_activations(model: mujoco.MjModel, qpos: NDArray[np.float64]) -> NDArray[np.float64]:
    """Activations (na,), `REST_ACTIVATION` at least, that hold a pose still, its contacts pushing upward.

    Solves min |A x - b|² + ε |x|², x = (a - rest, f) ≥ 0, by accelerated projected gradients: A takes activations and
    contact forces without friction [body weights] to generalised forces, b is what gravity and muscles at rest ask for.
    """
    data = mujoco.MjData(model)
    forces = []
    for activation in (REST_ACTIVATION, 1.0 + REST_ACTIVATION):
        data.qpos[:] = qpos
        data.act[:] = activation
        mujoco.mj_forward(model, data)
        forces.append(data.actuator_force[: model.na].copy())
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(
        moment, data.actuator_moment.ravel(), data.moment_rownnz, data.moment_rowadr, data.moment_colind.ravel()
    )
    moment = moment[: model.na]
    weight = float(-model.opt.gravity[2] * model.body_subtreemass[0])
    columns = [moment.T * (forces[1] - forces[0])]
    for k in range(data.ncon):
        jacobian = np.zeros((3, model.nv))
        body = int(model.geom_bodyid[data.contact.geom[k]].max())
        mujoco.mj_jac(model, data, jacobian, None, data.contact.pos[k], body)
        columns.append(weight * jacobian[2:3].T)
    matrix = np.concatenate(columns, axis=1)
    wanted = data.qfrc_bias - moment.T @ forces[0]
    # The rows belong to joints of very different strength: each is weighted by the torque its muscles can give.
    scale = 1.0 / np.maximum(np.linalg.norm(matrix, axis=1), 1.0)
    matrix, wanted = matrix * scale[:, None], wanted * scale
    ridge = np.zeros(matrix.shape[1])
    ridge[: model.na] = _LEAST_EFFORT
    rate = 1.0 / (np.linalg.norm(matrix, 2) ** 2 + _LEAST_EFFORT)
    x = momentum = np.zeros(matrix.shape[1])
    speed = 1.0
    for _ in range(_SOLVER_STEPS):
        slope = matrix.T @ (matrix @ momentum - wanted) + ridge * momentum
        new = np.maximum(momentum - rate * slope, 0.0)
        faster = (1.0 + np.sqrt(1.0 + 4.0 * speed**2)) / 2.0
        momentum = new + (speed - 1.0) / faster * (new - x)
        x, speed = new, faster
    return REST_ACTIVATION + x[: model.na]


def _address(model: mujoco.MjModel, joint: str) -> int:
    return int(model.jnt_qposadr[model.joint(joint).id])


def _posed(
    model: mujoco.MjModel, both: dict[str, float], right: dict[str, float], left: dict[str, float]
) -> mujoco.MjData:
    """Data with these joint angles of the trunk or both legs and of each leg, and up-to-date kinematics."""
    data = mujoco.MjData(model)
    for angles, sides in ((both, "rl"), (right, "r"), (left, "l")):
        for name, angle in angles.items():
            for joint in [name] if name.startswith("pelvis") else [f"{name}_{side}" for side in sides]:
                data.qpos[_address(model, joint)] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def _soles(side: str) -> list[str]:
    return [f"sole_{segment}{k}_{side}" for segment, spheres in OUTLINE.items() for k in range(len(spheres))]


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, sides: str) -> float:
    """Height of the lowest point of these soles [m]."""
    geoms = [model.geom(name).id for side in sides for name in _soles(side)]
    return float(min(data.geom_xpos[g, 2] - model.geom_size[g, 0] for g in geoms))


def _double_support(model: mujoco.MjModel, leading: str, trailing: str) -> mujoco.MjData:
    """Both feet touching the ground: the trailing knee bends until its toes are as low as the leading heel."""

    def posed(knee: float) -> tuple[mujoco.MjData, float]:
        behind = _TRAILING | {"knee_angle": knee}
        # Toes stay flat while the foot behind them is pitched.
        behind["mtp_angle"] = -(sum(behind.values()) + _TRUNK["pelvis_tilt"])
        legs = {leading: _LEADING, trailing: behind}
        data = _posed(model, _TRUNK, legs["r"], legs["l"])
        return data, _lowest(model, data, trailing) - _lowest(model, data, leading)

    straight, bent = -0.05, -0.7
    if not posed(straight)[1] < 0.0 < posed(bent)[1]:
        raise AssertionError("no bend of the trailing knee puts both feet on the ground")
    for _ in range(60):
        middle = (straight + bent) / 2.0
        straight, bent = (middle, bent) if posed(middle)[1] < 0.0 else (straight, middle)
    data, _ = posed((straight + bent) / 2.0)
    data.qpos[_address(model, "pelvis_ty")] -= _lowest(model, data, leading) + _PRESSED
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def _rolling(model: mujoco.MjModel, data: mujoco.MjData, leading: str, trailing: str) -> NDArray[np.float64]:
    """Smallest velocities with the pelvis moving forward at which the lowest points of both soles stand still."""
    rows = []
    for side in (leading, trailing):
        geom = min(
            (model.geom(name).id for name in _soles(side)),
            key=lambda g: data.geom_xpos[g, 2] - model.geom_size[g, 0],
        )
        place = data.geom_xpos[geom] - np.array([0.0, 0.0, model.geom_size[geom, 0]])
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, place, int(model.geom_bodyid[geom]))
        rows.append(jacobian[[0, 2]])
    contact = np.concatenate(rows)
    forward = _address(model, "pelvis_tx")
    moving = [
        _address(model, f"{name}_{side}") for name in ("hip_flexion", "knee_angle", "ankle_angle") for side in "rl"
    ]
    qvel = np.zeros(model.nv)
    qvel[forward] = WALKING_SPEED
    qvel[moving] = np.linalg.lstsq(contact[:, moving], -contact @ qvel, rcond=None)[0]
    return qvel
