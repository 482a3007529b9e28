"""An exported ant in C MuJoCo, without msk_ray, from the states of `msk_ray evaluate`: python run_ant.py ant.onnx"""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import onnxruntime
import torch

path = Path(sys.argv[1])
worlds, steps = (int(text) for text in sys.argv[2:4] or (64, 1000))
about = json.loads(path.with_suffix(".json").read_text())
model = mujoco.MjModel.from_binary_path(str(path.with_suffix(".mjb")))
policy = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
generator = torch.Generator().manual_seed(1234)  # that of evaluation.seed
noise = [2.0 * torch.rand(worlds, n, generator=generator).double().numpy() - 1.0 for n in (3, 3, 1, 8, 14)]
returns = np.zeros(worlds)
for world, (place, axis, turn, joints, velocity) in enumerate(zip(*noise, strict=True)):
    data = mujoco.MjData(model)
    data.qpos[:] = about["model"]["start"]["qpos"]
    mujoco.mju_axisAngle2Quat(data.qpos[3:7], axis / np.linalg.norm(axis), np.pi / 24.0 * turn[0])
    data.qpos[:3] += 0.1 * place
    data.qpos[7:] += 0.2 * joints
    data.qvel[:] = 0.25 * velocity
    action, rotation = np.zeros(8), np.zeros(9)
    for _ in range(steps):
        mujoco.mju_quat2Mat(rotation, data.qpos[3:7])
        axes = rotation.reshape(3, 3)
        state = (data.qpos[2:7], data.qvel[:3], axes @ data.qvel[3:6], data.qpos[7:], 0.1 * data.qvel[6:])
        obs = np.concatenate((*state, (axes[2, 2], axes[0, 0]), action))[None].astype(np.float32)
        (action,), (data.ctrl[:],) = policy.run(None, {"obs": obs})
        mujoco.mj_step(model, data, about["physics_steps_per_control"])
        mujoco.mju_quat2Mat(rotation, data.qpos[3:7])
        returns[world] += data.qvel[0] + 0.1 * rotation[8] + rotation[0] + data.qpos[2] - 0.27
        if data.qpos[2] < 0.27:
            break
print(f"mean return of {worlds} episodes: {returns.mean():.2f} ± {returns.std(ddof=1):.2f}")
