"""A policy that follows a motion, in C MuJoCo, without msk_ray; it needs onnxruntime, and ten seconds for the dance:

    msk-ray export g1_dance --onnx dance.onnx
    msk-ray motions g1/dance1_subject2.csv --npz .
    python run_tracking.py dance.onnx dance1_subject2.npz

For policies with actions about the reference and `env.layout: full`. Prints how much of the clip was followed, and
`motion`, the return without costs, as `msk-ray track` does.
"""

import json
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import onnxruntime

BODIES = ["pelvis", "torso_link"]
for side in ("left", "right"):
    BODIES += [f"{side}_{part}_link" for part in ("hip_roll", "knee", "ankle_roll")]
    BODIES += [f"{side}_{part}_link" for part in ("shoulder_roll", "elbow", "wrist_yaw")]

if len(sys.argv) != 3:
    sys.exit(__doc__)
path, clip = Path(sys.argv[1]), dict(np.load(sys.argv[2]))
about = json.loads(path.with_suffix(".json").read_text())
settings = about["trained"]["env_settings"]
future = settings.get("future_frames", [])
if about["observation"]["size"] != 160 + 67 * len(future):
    sys.exit(f"{path}: not for this observation: train with env.layout full, without history")
if settings["action_about"] != "reference":
    sys.exit(f"{path}: not for these actions: train with env.action_about reference")
model = mujoco.MjModel.from_binary_path(str(path.with_suffix(".mjb")))
policy = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
data = mujoco.MjData(model)
robot = [model.body(name).id for name in BODIES]
first = model.body("pelvis").id  # the clip has all bodies of the robot in the model's order, from the pelvis on
reference = {name: clip[f"body_{name}_w"][:, np.array(robot) - first] for name in ("pos", "quat", "lin_vel", "ang_vel")}
torso = BODIES.index("torso_link")
joints = [model.joint(name).id for name in about["action"]["names"]]
servos = [np.flatnonzero(model.actuator_trnid[:, 0] == joint)[0] for joint in joints]
unit = 0.25 * model.actuator_forcerange[servos, 1] / model.actuator_gainprm[servos, 0]  # of mjlab's actions [rad]
default = model.key_qpos[0, 7:]


def matrix(quat):
    """Rotation matrices (..., 3, 3) of quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]]
    rows += [[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]]
    rows += [[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def heading(turn):
    """The rotation about the vertical axis in a rotation matrix."""
    yaw = np.arctan2(turn[1, 0], turn[0, 0])
    return np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])


def angle(a, b):
    """Angles [rad] between rotation matrices (..., 3, 3)."""
    return np.arccos(np.clip((np.sum(a * b, axis=(-2, -1)) - 1.0) / 2.0, -1.0, 1.0))


def closeness(square, spread):
    """1 where squares of differences are 0, falling over the spread, which is mjlab's."""
    return np.exp(-np.mean(square) / spread**2)


def seen(frame):
    """What the policy sees of the reference in a frame: joints, and the torso in the axes of the robot's."""
    axes = data.xmat[robot[torso]].reshape(3, 3)
    offset = axes.T @ (reference["pos"][frame, torso] - data.xpos[robot[torso]])
    return [clip["joint_pos"][frame], clip["joint_vel"][frame], offset, (axes.T @ turns[frame, torso])[:, :2].ravel()]


turns = matrix(reference["quat"])
data.qpos[:3], data.qpos[3:7], data.qpos[7:] = reference["pos"][0, 0], reference["quat"][0, 0], clip["joint_pos"][0]
data.qvel[:3], data.qvel[3:6] = reference["lin_vel"][0, 0], turns[0, 0].T @ reference["ang_vel"][0, 0]
data.qvel[6:] = clip["joint_vel"][0]
action = (clip["joint_pos"][0] - default) / unit  # as if the last one had asked for the first pose
frames, total, printed = len(clip["joint_pos"]), 0.0, time.monotonic()
for frame in range(frames):
    if time.monotonic() > printed + 10.0:
        printed = time.monotonic()
        print(f"  {frame} of {frames} frames", flush=True)
    mujoco.mj_forward(model, data)
    obs = [
        *seen(frame),
        data.sensor("imu_lin_vel").data,
        data.sensor("imu_ang_vel").data,
        data.qpos[7:] - default,
        data.qvel[6:],
        action,
        *(part for ahead in future for part in seen(min(frame + ahead, frames - 1))),
    ]
    (output,) = policy.run(["action"], {"obs": np.concatenate(obs)[None].astype(np.float32)})
    action = settings["action_range"] * output[0] + (clip["joint_pos"][frame] - default) / unit
    data.ctrl[servos] = default + unit * action
    mujoco.mj_step(model, data, about["physics_steps_per_control"])
    mujoco.mj_forward(model, data)
    position, rotation = data.xpos[robot], data.xmat[robot].reshape(-1, 3, 3)
    velocity = np.zeros((len(robot), 6))
    for row, body in zip(velocity, robot, strict=True):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, row, 0)
    # As in mjlab, the state after the step is compared with the frame that the policy saw before it.
    place, turn = reference["pos"][frame], turns[frame]
    if abs(place[0, 2] - position[0, 2]) > 0.25 or abs(turn[0, 2, 2] - rotation[0, 2, 2]) > 0.8:
        break
    to_robot = heading(rotation[torso] @ turn[torso].T)
    there = np.append(position[torso, :2], place[torso, 2]) + (place - place[torso]) @ to_robot.T
    total += 0.5 * closeness(np.sum((place[torso] - position[torso]) ** 2), 0.3)
    total += 0.5 * closeness(angle(turn[torso], rotation[torso]) ** 2, 0.4)
    total += closeness(np.sum((there - position) ** 2, axis=-1), 0.3)
    total += closeness(angle(to_robot @ turn, rotation) ** 2, 0.4)
    total += closeness(np.sum((reference["lin_vel"][frame] - velocity[:, 3:]) ** 2, axis=-1), 1.0)
    total += closeness(np.sum((reference["ang_vel"][frame] - velocity[:, :3]) ** 2, axis=-1), 3.14)
print(f"followed {(frame + 1) / frames:.0%}, motion {total / (5.0 * frames):.3f}")
