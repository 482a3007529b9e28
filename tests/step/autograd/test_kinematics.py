"""Poses, velocities and centres of mass in the graph, against C MuJoCo and its central differences."""

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.config import PhysicsConfig
from msk_ray.errors import ConfigError
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.model import build_myoleg26
from msk_ray.step.autograd.kinematics import Frames, Kinematics
from msk_ray.step.forward import WorldBatch

EVERY_JOINT = """<mujoco><worldbody>
<body name="base" pos="1 2 3"><freejoint/><geom type="box" size=".1 .2 .3" mass="2" pos=".1 0 0"/>
  <body name="arm" pos=".3 .1 0" quat=".8 .6 0 0"><joint type="ball" pos=".02 .03 .04"/>
    <geom name="g" type="capsule" fromto="0 0 0 .3 .1 .2" size=".03" mass="1"/>
    <site name="tip" pos=".2 .1 .1" quat=".5 .5 .5 .5"/>
    <body name="hand" pos=".3 0 .1"><joint axis="1 .3 0" type="slide" ref=".1"/>
      <joint axis="0 1 .2" pos="0 .05 .02" ref=".3"/><joint axis="0 0 1"/>
      <geom type="sphere" size=".05" mass=".5" pos="0 .02 0"/><site name="end" pos="0 .1 0"/></body></body></body>
<body name="post" pos="0 0 1"><geom type="sphere" size=".1" mass="3"/><body name="flag" pos="0 0 .5">
  <joint axis="0 0 1"/><geom type="box" size=".1 .01 .05" mass=".2" pos=".1 0 0"/></body></body>
</worldbody></mujoco>"""
WORLDS = 3


def models() -> dict[str, mujoco.MjModel]:
    return {
        "every joint": mujoco.MjModel.from_xml_string(EVERY_JOINT),
        "myoleg26": build_myoleg26(MyoLeg26Settings(name="myoleg26"), PhysicsConfig()),
    }


def readings(frames: Frames, model: mujoco.MjModel) -> torch.Tensor:
    """Everything `Frames` offers, (W, ·)."""
    bodies, sites, geoms = list(range(model.nbody)), list(range(model.nsite)), list(range(model.ngeom))
    parts = (
        frames.position(bodies),
        frames.axis(bodies, 0),
        frames.axis(bodies, 2),
        frames.velocity(bodies),
        frames.angular_velocity(bodies),
        frames.site_position(sites),
        frames.site_velocity(sites),
        frames.geom_position(geoms),
        frames.geom_velocity(geoms),
        frames.center_of_mass(bodies[1:]),
        frames.com_velocity(bodies[1:]),
        frames.angular_momentum(bodies[1:]),
    )
    return torch.cat([part.flatten(1) for part in parts], -1)


def exact(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """The same from C MuJoCo in float64."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_subtreeVel(model, data)

    def velocity(kind: mujoco.mjtObj, count: int) -> np.ndarray:
        found = np.zeros((count, 6))
        for i in range(count):
            mujoco.mj_objectVelocity(model, data, kind, i, found[i], 0)
        return found

    bodies = velocity(mujoco.mjtObj.mjOBJ_XBODY, model.nbody)
    mats = data.xmat.reshape(-1, 3, 3)
    parts = (
        data.xpos,
        mats[:, :, 0],
        mats[:, :, 2],
        bodies[:, 3:],
        bodies[:, :3],
        data.site_xpos,
        velocity(mujoco.mjtObj.mjOBJ_SITE, model.nsite)[:, 3:],
        data.geom_xpos,
        velocity(mujoco.mjtObj.mjOBJ_GEOM, model.ngeom)[:, 3:],
        data.subtree_com[1:],
        data.subtree_linvel[1:],
        data.subtree_angmom[1:],
    )
    return np.concatenate([part.ravel() for part in parts])


def states(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    qpos = np.tile(model.qpos0, (WORLDS, 1))
    for row in qpos[1:]:  # the first stays at the reference, where rotations are none
        mujoco.mj_integratePos(model, row, 0.4 * rng.normal(size=model.nv), 1.0)
    return qpos, rng.normal(size=(WORLDS, model.nv))


@pytest.mark.parametrize("which", ["every joint", "myoleg26"])
def test_values_and_gradients(which: str) -> None:
    model = models()[which]
    kinematics = Kinematics(WorldBatch(model, WORLDS, 1, "cpu"))
    qpos, qvel = states(model)
    q = torch.tensor(qpos, dtype=torch.float32, requires_grad=True)
    v = torch.tensor(qvel, dtype=torch.float32, requires_grad=True)
    found = readings(kinematics(q, v), model)
    expected = np.stack([exact(model, a, b) for a, b in zip(qpos, qvel, strict=True)])
    np.testing.assert_allclose(found.detach().numpy(), expected, atol=2e-5)
    weights = np.random.default_rng(3).normal(size=expected.shape)
    kinematics(q.detach() + 0.1, v.detach())  # another state in the shared buffers must not reach the gradient
    grad_q, grad_v = torch.autograd.grad((found * torch.tensor(weights, dtype=torch.float32)).sum(), (q, v))
    eps = 1e-6
    for w in range(WORLDS):
        slopes_q, slopes_v, tangent = np.zeros(model.nv), np.zeros(model.nv), np.zeros(model.nv)
        for i, direction in enumerate(np.eye(model.nv)):
            ends = []
            for sign in (eps, -eps):
                moved = qpos[w].copy()
                mujoco.mj_integratePos(model, moved, direction, sign)
                ends.append((moved, exact(model, moved, qvel[w]) @ weights[w]))
            slopes_q[i] = (ends[0][1] - ends[1][1]) / (2 * eps)
            # The raw gradient along the curve that integration follows.
            tangent[i] = grad_q[w].double().numpy() @ (ends[0][0] - ends[1][0]) / (2 * eps)
            up, down = (exact(model, qpos[w], qvel[w] + s * direction) @ weights[w] for s in (eps, -eps))
            slopes_v[i] = (up - down) / (2 * eps)
        scale_q, scale_v = np.abs(slopes_q).max(), np.abs(slopes_v).max()
        np.testing.assert_allclose(tangent, slopes_q, atol=1e-5 * scale_q)
        np.testing.assert_allclose(grad_v[w], slopes_v, atol=1e-5 * scale_v)


def test_a_quaternion_that_is_not_of_unit_length_counts_by_its_direction() -> None:
    model = models()["every joint"]
    kinematics = Kinematics(WorldBatch(model, WORLDS, 1, "cpu"))
    qpos, qvel = (torch.tensor(part, dtype=torch.float32) for part in states(model))
    stretched = qpos.clone()
    stretched[:, 3:7] *= 2.0
    stretched.requires_grad_()
    frames = kinematics(stretched, qvel)
    torch.testing.assert_close(frames.position("hand"), kinematics(qpos, qvel).position("hand"), atol=1e-6, rtol=0)
    (gradient,) = torch.autograd.grad(frames.position("hand").sum(), stretched)
    # Along itself a quaternion turns nothing.
    assert (gradient[:, 3:7] * stretched[:, 3:7]).sum(-1).abs().max() < 1e-5


def test_names_ids_and_lists() -> None:
    model = models()["every joint"]
    kinematics = Kinematics(WorldBatch(model, WORLDS, 1, "cpu"))
    frames = kinematics(*(torch.tensor(part, dtype=torch.float32) for part in states(model)))
    hand = model.body("hand").id
    assert frames.position("hand").shape == (WORLDS, 3)
    assert frames.position(["arm", "hand"]).shape == (WORLDS, 2, 3)
    assert torch.equal(frames.position(hand), frames.position(["arm", "hand"])[:, 1])
    assert frames.orientation("arm").shape == (WORLDS, 4)
    assert frames.site_orientation("tip").norm(dim=-1) == pytest.approx(1.0, abs=1e-6)
    with pytest.raises(ConfigError, match=r"no body 'foot': it has world, base, arm, hand, post, flag"):
        frames.position("foot")
    with pytest.raises(ConfigError, match="no site 7: write 0 to 1"):
        frames.site_position(7)
