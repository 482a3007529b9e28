"""Contact forces by geom, against C MuJoCo."""

import mujoco
import numpy as np
import pytest
from scenes import ant

from msk_ray.step.forward import WorldBatch
from msk_ray.step.forward.contact_forces import ContactForces


def exact(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Force on each geom in world coordinates, (G, 3)."""
    total, wrench = np.zeros((model.ngeom, 3)), np.zeros(6)
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, wrench)
        force = data.contact[i].frame.reshape(3, 3).T @ wrench[:3]
        total[data.contact[i].geom[1]] += force
        total[data.contact[i].geom[0]] -= force
    return total


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_forces_by_geom_are_those_of_c_mujoco(cone: str) -> None:
    model = ant(cone)
    data = mujoco.MjData(model)
    data.qpos[2] = 0.5
    mujoco.mj_step(model, data, 200)
    qpos, qvel = data.qpos.copy(), data.qvel.copy()
    qvel[:2] += 0.3  # friction too
    batch = WorldBatch(model, 2, 1, "cpu", tolerance=1e-9)
    forces = ContactForces(batch.model, batch.data)
    # The second world is high in the air.
    flying = qpos.copy()
    flying[2] += 5.0
    batch.data.qpos.assign(np.stack((qpos, flying)).astype(np.float32))
    batch.data.qvel.assign(np.stack((qvel, qvel)).astype(np.float32))
    batch.launch_step()
    forces.launch()
    data.qpos[:], data.qvel[:], data.ctrl[:], data.qacc_warmstart[:] = qpos, qvel, 0.0, 0.0
    mujoco.mj_forward(model, data)
    expected = exact(model, data)
    found = forces.force.numpy()
    assert np.abs(expected[:, :2]).max() > 1.0
    np.testing.assert_allclose(found[0], expected, atol=2e-3 * np.abs(expected).max())
    assert expected[0, 2] == pytest.approx(-expected[1:, 2].sum())  # the floor carries what the legs press
    assert not found[1].any()
    forces.launch()
    np.testing.assert_array_equal(forces.force.numpy(), found)
