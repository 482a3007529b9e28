"""Derivatives of contacts of boxes against central differences of MuJoCo Warp's own collision detection.

Two faces that lie on each other collide differently in MuJoCo Warp and in C MuJoCo, so here the oracle is MuJoCo Warp:
weighted sums of distance, point and normal, over all twelve displacements of two free bodies.
"""

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
from contact_pairs import PlacedContact, displaced, pulled, turned, whole_turned

EPS = 2e-3
SIZES = {"box": (0.1, 0.07, 0.05), "capsule": (0.04, 0.15, 0.0), "ground": (0.2, 0.15, 0.1)}


def two_bodies(shape: str, flag: str, margin: float) -> mujoco.MjModel:
    """A capsule or box above a larger box, both free."""
    size = " ".join(str(s) for s in SIZES[shape][: 2 if shape == "capsule" else 3])
    ground = " ".join(str(s) for s in SIZES["ground"])
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option><flag {flag}/></option><default><geom margin="{margin}"/></default><worldbody>
        <body><freejoint/><geom type="{shape}" size="{size}"/></body>
        <body><freejoint/><geom type="box" size="{ground}"/></body></worldbody></mujoco>"""
    )


def touching(model: mujoco.MjModel, shape: str, tilt: float, rng: np.random.Generator) -> np.ndarray:
    """A pose in which the upper body has been lowered onto the lower one until it touches, tilted a little."""
    data = mujoco.MjData(model)
    quat = np.array([np.sqrt(0.5), 0, np.sqrt(0.5), 0]) if shape == "capsule" else np.array([1.0, 0, 0, 0])
    quat = turned(turned(quat, np.array([0, 0, rng.uniform(0, 6.28)])), tilt * np.array([*rng.normal(size=2), 0.0]))
    whole = rng.normal(size=3)
    for height in np.arange(0.35, 0.05, -5e-4):
        data.qpos[:3] = (
            [0.08 * rng.normal(), 0.08 * rng.normal(), height] if height == 0.35 else [*data.qpos[:2], height]
        )
        data.qpos[3:7] = quat
        data.qpos[7:] = [0, 0, 0, 1, 0, 0, 0]
        mujoco.mj_forward(model, data)
        if data.ncon and float(np.min(data.contact.dist)) < -0.008:
            break
    return whole_turned(np.array(data.qpos), whole)


def contacts(model: mujoco.MjModel, poses: np.ndarray) -> tuple[list[dict[int, np.ndarray]], np.ndarray, np.ndarray]:
    """By world: contact index to (dist, point, normal) in 7 numbers; and the geoms' positions and rotations."""
    m = mjw.put_model(model)
    d = mjw.make_data(model, nworld=len(poses), nconmax=16, njmax=64)
    d.qpos.assign(poses.astype(np.float32))
    mjw.kinematics(m, d)
    mjw.com_pos(m, d)
    mjw.collision(m, d)
    count = int(d.nacon.numpy()[0])
    found: list[dict[int, np.ndarray]] = [{} for _ in poses]
    for world, index, dist, point, frame in zip(
        d.contact.worldid.numpy()[:count],
        d.contact.geomcollisionid.numpy()[:count],
        d.contact.dist.numpy()[:count],
        d.contact.pos.numpy()[:count],
        d.contact.frame.numpy()[:count],
        strict=True,
    ):
        found[world][int(index)] = np.concatenate([[dist], point, frame[0]])
    return found, d.geom_xpos.numpy(), d.geom_xmat.numpy()


@pytest.mark.parametrize(
    ("shape", "tilt", "flag", "margin"),
    [
        ("box", 0.02, "", 0.0),
        ("box", 0.3, "", 0.0),
        ("box", 0.3, "", 0.03),
        ("box", 0.02, 'nativeccd="disable"', 0.0),
        ("box", 0.5, 'nativeccd="disable"', 0.0),
        ("capsule", 0.05, "", 0.0),
        ("capsule", 0.4, "", 0.0),
        ("capsule", 0.4, "", 0.03),
    ],
)
def test_contact_follows_both_bodies(shape, tilt, flag, margin):
    rng = np.random.default_rng(1)
    model = two_bodies(shape, flag, margin)
    poses = [touching(model, shape, tilt, rng) for _ in range(24)]
    found, geom_pos, geom_mat = contacts(model, np.array([moved for p in poses for moved in (p, *displaced(p, EPS))]))
    rows, expected = [], []
    for i in range(len(poses)):
        worlds = found[25 * i : 25 * (i + 1)]
        for index, contact in worlds[0].items():
            # A contact that begins, ends or changes its place in the list inside the differences has no derivative.
            if any(index not in w or len(w) != len(worlds[0]) for w in worlds):
                continue
            weight = np.concatenate([[3.0 * rng.normal()], rng.normal(size=6)])
            moved = np.array([weight @ w[index] for w in worlds[1:]]).reshape(12, 2)
            curved = np.abs(moved.sum(1) - 2 * weight @ contact).max() / EPS
            if curved > 0.05:  # a kink inside the differences
                continue
            rows.append(PlacedContact(geom_pos[25 * i], geom_mat[25 * i], geom_pos[25 * i], index, contact, weight))
            expected.append((moved[:, 0] - moved[:, 1]) / (2 * EPS))
    assert len(rows) >= 12
    wrenches, _exact = pulled(model, rows)
    error = np.linalg.norm(wrenches - expected, axis=1) / np.linalg.norm(expected, axis=1)
    print(f"{len(rows)} contacts, median {np.median(error):.1e}, largest {error.max():.1e}")
    # Float32 differences: 1e-3 of rounding, and curvature times the step.
    assert np.median(error) < 2e-3
    assert error.max() < 2e-2
