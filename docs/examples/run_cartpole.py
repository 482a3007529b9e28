"""An exported CartPole in C MuJoCo, without msk_ray: python run_cartpole.py cartpole.onnx

Episodes start where those of `msk_ray evaluate` do, so that their mean return can be compared with its score.
"""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import onnxruntime
import torch

path = Path(sys.argv[1])
worlds, steps = (int(text) for text in sys.argv[2:4] or (64, 240))
about = json.loads(path.with_suffix(".json").read_text())
model = mujoco.MjModel.from_binary_path(str(path.with_suffix(".mjb")))
policy = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
generator = torch.Generator().manual_seed(1234)  # that of evaluation.seed
noise = [2.0 * torch.rand(worlds, 2, generator=generator).numpy() - 1.0 for _ in range(2)]
all_data = [mujoco.MjData(model) for _ in range(worlds)]
for data, position, velocity in zip(all_data, *noise, strict=True):
    data.qpos[:] = about["model"]["start"]["qpos"] + np.array([0.5, np.pi / 2.0]) * position
    data.qvel[:] = 0.25 * velocity

returns = np.zeros(worlds)
for _ in range(steps):
    qpos, qvel = (np.array([getattr(data, name) for data in all_data]) for name in ("qpos", "qvel"))
    obs = np.stack((qpos[:, 0], qvel[:, 0], np.sin(qpos[:, 1]), np.cos(qpos[:, 1]), qvel[:, 1]), axis=-1)
    action, ctrl = policy.run(None, {"obs": obs.astype(np.float32)})
    for world, data in enumerate(all_data):
        data.ctrl[:] = ctrl[world]
        mujoco.mj_step(model, data, about["physics_steps_per_control"])
        angle = (data.qpos[1] + np.pi) % (2.0 * np.pi) - np.pi
        returns[world] -= angle**2 + 0.1 * data.qvel[1] ** 2 + 0.05 * data.qpos[0] ** 2 + 0.1 * data.qvel[0] ** 2
print(f"mean return of {worlds} episodes: {returns.mean():.2f} ± {returns.std(ddof=1):.2f}")
