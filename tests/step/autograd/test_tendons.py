"""Lengths and rates of tendons, against C MuJoCo and its central differences."""

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.config import PhysicsConfig
from msk_ray.errors import UnsupportedModelError
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.model import build_myoleg26
from msk_ray.step.autograd.tendon_lengths import Tendons
from msk_ray.step.forward import WorldBatch

FREE_ARM = """<mujoco><worldbody><body><freejoint/><geom size=".1" mass="1"/><site name="a" pos="0 .1 .1"/>
<body pos=".3 0 0"><joint type="ball"/><geom size=".1" mass="1"/><site name="b" pos=".1 0 .1"/>
<geom name="w" type="cylinder" size=".05 .1" pos="0 0 0" mass="1"/></body></body></worldbody>
<tendon><spatial name="t"><site site="a"/><geom geom="w"/><site site="b"/></spatial></tendon></mujoco>"""


def lengths_and_rates(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    return np.concatenate((data.ten_length, data.ten_velocity))


@pytest.mark.parametrize("which", ["myoleg26", "free and ball joints"])
def test_lengths_rates_and_their_gradients(which: str) -> None:
    if which == "myoleg26":
        model = build_myoleg26(MyoLeg26Settings(name="myoleg26"), PhysicsConfig())
    else:
        model = mujoco.MjModel.from_xml_string(FREE_ARM)
    rng = np.random.default_rng(1)
    worlds = 3
    tendons = Tendons(WorldBatch(model, worlds, 1, "cpu"))
    qpos = np.tile(model.qpos0, (worlds, 1))
    for row in qpos:
        mujoco.mj_integratePos(model, row, 0.3 * rng.normal(size=model.nv), 1.0)
    qvel = rng.normal(size=(worlds, model.nv))
    weights = rng.normal(size=(worlds, 2 * model.ntendon))
    q = torch.tensor(qpos, dtype=torch.float32, requires_grad=True)
    v = torch.tensor(qvel, dtype=torch.float32, requires_grad=True)
    length, rate = tendons(q, v)
    found = torch.cat((length, rate), -1)
    exact = np.stack([lengths_and_rates(model, a, b) for a, b in zip(qpos, qvel, strict=True)])
    np.testing.assert_allclose(found.detach().numpy(), exact, atol=2e-6)
    tendons(q.detach() + 0.1, v.detach())  # another state in the shared buffers must not reach the gradient
    grad_q, grad_v = torch.autograd.grad((found * torch.tensor(weights, dtype=torch.float32)).sum(), (q, v))
    eps = 1e-6
    for w in range(worlds):
        expected_q, expected_v = np.zeros(model.nv), np.zeros(model.nv)
        tangent = np.zeros(model.nv)
        for i in range(model.nv):
            direction = np.eye(model.nv)[i]
            ends = []
            for sign in (eps, -eps):
                moved = qpos[w].copy()
                mujoco.mj_integratePos(model, moved, direction, sign)
                ends.append(lengths_and_rates(model, moved, qvel[w]) @ weights[w])
            expected_q[i] = (ends[0] - ends[1]) / (2 * eps)
            expected_v[i] = (
                (
                    lengths_and_rates(model, qpos[w], qvel[w] + eps * direction)
                    - lengths_and_rates(model, qpos[w], qvel[w] - eps * direction)
                )
                @ weights[w]
                / (2 * eps)
            )
            # The raw gradient's slope along this tangent direction.
            moved = qpos[w].copy()
            mujoco.mj_integratePos(model, moved, direction, 1e-7)
            tangent[i] = grad_q[w].numpy().astype(float) @ (moved - qpos[w]) / 1e-7
        scale = np.linalg.norm(expected_q)
        assert np.linalg.norm(tangent - expected_q) < 2e-5 * scale
        assert np.linalg.norm(grad_v[w].numpy() - expected_v) < 1e-5 * np.linalg.norm(expected_v)


def test_a_model_without_tendons_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(UnsupportedModelError, match="no tendons"):
        Tendons(WorldBatch(model, 1, 1, "cpu"))
