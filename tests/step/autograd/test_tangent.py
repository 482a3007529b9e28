"""Tangent-space arithmetic against C MuJoCo, and laws it must obey."""

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.step.autograd.tangent import Tangent, quat_exp, quat_log, quat_multiply, quat_rotate, quat_yaw

XML = """
<mujoco><worldbody>
  <body><freejoint/><geom size="0.1"/>
    <body pos="0.3 0 0"><joint type="ball"/><geom size="0.1"/>
      <body pos="0.3 0 0"><joint type="hinge"/><geom size="0.1"/>
        <body pos="0.3 0 0"><joint type="slide"/><geom size="0.1"/></body></body></body></body>
</worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def random_qpos(model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    qpos = model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), 1.0)
    return qpos


def test_integrate_and_difference_agree_with_mujoco(model: mujoco.MjModel) -> None:
    rng = np.random.default_rng(0)
    tangent = Tangent(model, torch.device("cpu"))
    for _ in range(20):
        start, end, delta = random_qpos(model, rng), random_qpos(model, rng), rng.normal(size=model.nv)
        expected = start.copy()
        mujoco.mj_integratePos(model, expected, delta, 1.0)
        got = tangent.integrate(torch.tensor(start)[None], torch.tensor(delta)[None])[0]
        np.testing.assert_allclose(got, expected, atol=1e-12)
        expected_delta = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, expected_delta, 1.0, start, end)
        got = tangent.difference(torch.tensor(start)[None], torch.tensor(end)[None])[0]
        np.testing.assert_allclose(got, expected_delta, atol=1e-9)


def test_no_rotation_is_exact() -> None:
    zero = torch.zeros(3)
    assert torch.equal(quat_exp(zero), torch.tensor([1.0, 0.0, 0.0, 0.0]))
    assert torch.equal(quat_log(quat_exp(zero)), zero)
    tiny = torch.tensor([1e-6, -2e-6, 3e-6])
    assert torch.allclose(quat_log(quat_exp(tiny)), tiny, rtol=1e-4)


def test_projecting_a_lifted_gradient_gives_it_back(model: mujoco.MjModel) -> None:
    rng = np.random.default_rng(1)
    tangent = Tangent(model, torch.device("cpu"))
    qpos = torch.tensor(np.stack([random_qpos(model, rng) for _ in range(5)]))
    gradient = torch.randn(5, model.nv, dtype=torch.float64)
    raw = tangent.lift(qpos, gradient)
    assert torch.allclose(tangent.project(qpos, raw), gradient)
    # No component along a unit quaternion, where the physics is constant.
    assert torch.allclose((raw[:, 3:7] * qpos[:, 3:7]).sum(-1), torch.zeros(5, dtype=torch.float64), atol=1e-12)


def test_project_is_the_derivative_along_tangent_directions(model: mujoco.MjModel) -> None:
    rng = np.random.default_rng(2)
    tangent = Tangent(model, torch.device("cpu"))
    qpos = torch.tensor(random_qpos(model, rng))[None]
    weights = torch.randn(1, model.nq, dtype=torch.float64)  # f(q) = ⟨weights, q⟩ has raw gradient `weights`
    projected = tangent.project(qpos, weights)[0]
    for i in range(model.nv):
        delta = torch.zeros(1, model.nv, dtype=torch.float64)
        delta[0, i] = 1e-6
        up, down = tangent.integrate(qpos, delta), tangent.integrate(qpos, -delta)
        assert torch.isclose(((up - down) * weights).sum() / 2e-6, projected[i], atol=1e-8)


def test_rotation_of_a_product_is_rotation_twice() -> None:
    torch.manual_seed(0)
    a, b, v = quat_exp(torch.randn(4, 3)), quat_exp(torch.randn(4, 3)), torch.randn(4, 3)
    assert torch.allclose(quat_rotate(quat_multiply(a, b), v), quat_rotate(a, quat_rotate(b, v)), atol=1e-6)


def test_a_lifted_gradient_is_that_of_a_function_that_normalises_quaternions(model: mujoco.MjModel) -> None:
    """By automatic differentiation of ⟨w, q/|q|⟩, at quaternions of lengths from 0.5 to 1.5."""
    rng = np.random.default_rng(2)
    tangent = Tangent(model, torch.device("cpu"))
    qpos = torch.tensor(np.stack([random_qpos(model, rng) for _ in range(5)]))
    weights = torch.randn(5, model.nq, dtype=torch.float64)
    scale = torch.linspace(0.5, 1.5, 5, dtype=torch.float64)[:, None]
    raw = qpos.clone()
    for quaternion in (slice(3, 7), slice(7, 11)):
        raw[:, quaternion] *= scale
    raw.requires_grad_()
    parts = (raw[:, :3], *(torch.nn.functional.normalize(raw[:, q], dim=-1) for q in (slice(3, 7), slice(7, 11))))
    unit = torch.cat((*parts, raw[:, 11:]), dim=-1)
    (expected,) = torch.autograd.grad((weights * unit).sum(), raw)
    found = tangent.lift(raw.detach(), tangent.project(qpos, weights))
    assert torch.allclose(found, expected)
    assert torch.allclose(tangent.lift(raw.detach(), tangent.project(raw.detach(), expected)), expected)


def test_yaw_is_that_of_the_turned_x_axis() -> None:
    turn = quat_exp(torch.tensor([[0.0, 0.0, 0.7], [0.0, 0.0, -2.9]], dtype=torch.float64))
    pitch, roll = quat_exp(torch.tensor([[0.0, 0.4, 0.0], [1.1, 0.0, 0.0]], dtype=torch.float64))
    tilted = quat_multiply(turn, quat_multiply(pitch.expand(2, 4), roll.expand(2, 4)))
    torch.testing.assert_close(quat_yaw(tilted), torch.tensor([0.7, -2.9], dtype=torch.float64))
    torch.testing.assert_close(quat_yaw(-tilted), quat_yaw(tilted))
