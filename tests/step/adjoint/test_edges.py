"""Contacts at edges and corners between faces that are nearly level, against differences of C MuJoCo.

The normal is then nearly that of a face, and only where the contact lies tells that it turns with the other geom.
"""

import warnings

import mujoco
import numpy as np
import pytest
from oracle import Point, differences, relative, rollout, simulate, tighten

from msk_ray.step import TapePerSubstep

pytestmark = pytest.mark.long

RADIUS, SLOPE = 0.05, 0.01


def scene(geom: str, asset: str, other: str) -> mujoco.MjModel:
    return tighten(
        mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep=".002" cone="elliptic"/><asset>{asset}</asset><worldbody><geom {geom}/>
            <body><freejoint/><geom {other}/></body></worldbody></mujoco>"""
        )
    )


def mesh(points: np.ndarray) -> str:
    return f'<mesh name="hull" vertex="{" ".join(f"{x:.7f}" for x in points.ravel())}"/>'


def roof() -> np.ndarray:
    """A roof whose ridge is the y axis, with faces at ±.01 rad."""
    across, down = 0.2 * np.cos(SLOPE), -0.2 * np.sin(SLOPE)
    return np.array([(x, y, z) for y in (-0.2, 0.2) for x, z in ((0, 0), (across, down), (-across, down), (0, -0.2))])


def ball(level: int) -> np.ndarray:
    """Corners of an icosahedron whose edges were halved `level` times, on a sphere of radius .1."""
    g = (1 + np.sqrt(5)) / 2
    found = [(s * a, t * b, 0.0) for s in (-1, 1) for t in (-1, 1) for a, b in ((1.0, g),)]
    points = np.array([np.roll(p, k) for p in found for k in range(3)])
    points /= np.linalg.norm(points, axis=1)[:, None]
    for _ in range(level):
        gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
        least = np.sort(gaps + 9 * np.eye(len(points)), axis=1)[:, :5].max()
        pairs = np.argwhere((gaps < 1.05 * least) & (gaps > 0))
        middles = np.array([points[a] + points[b] for a, b in pairs if a < b])
        points = np.vstack([points, middles / np.linalg.norm(middles, axis=1)[:, None]])
    return 0.1 * points


def check(model: mujoco.MjModel, points: list[Point], least: int) -> None:
    """Gradients of all states that C MuJoCo steps alike, away from kinks, of which there are `least` or more."""
    rng = np.random.default_rng(0)
    weights = {n: rng.normal(size=(len(points), 6)).astype(np.float32).astype(float) for n in ("qpos", "qvel")}
    weights["act"] = np.zeros((len(points), 0))
    end, found, sim = simulate(model, TapePerSubstep(), points, 1, weights)
    errors = []
    for i, point in enumerate(points):
        own = {n: w[i] for n, w in weights.items()}
        expected, kink = differences(model, point, 1, own)
        wider, _ = differences(model, point, 1, own, 1e-5)
        after = rollout(model, point, 1)
        if after.ncon == 0 or kink > 0.05 or relative(wider["qpos"], expected["qpos"]) > 1e-2:
            continue
        if relative(end.qvel[i].detach().numpy(), after.qvel) > 1e-4:
            continue
        errors.append(max(relative(found[n][i], expected[n]) for n in ("qpos", "qvel")))
    assert len(errors) >= least
    assert max(errors) < 2e-3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert sim.diagnostics()["approximated_share"] == 0.0


def state(qpos: list[float] | np.ndarray, rng: np.random.Generator) -> Point:
    qvel = rng.normal(size=6) * [0.3, 0.3, 0.3, 2, 2, 2]
    return Point(*(np.asarray(v, np.float32).astype(float) for v in (qpos, qvel, [], [])))


def test_a_sphere_on_a_roof() -> None:
    """Angles of the normal from the vertical up to that of the faces, and beyond, where the contact is a face's."""
    rng = np.random.default_rng(0)
    model = scene('type="mesh" mesh="hull"', mesh(roof()), f'size="{RADIUS}" density="1000"')
    angles = [0, 0.003, 0.0085, 0.0092, 0.0095, 0.0099, 0.00995, 0.01005, 0.0105, 0.02]
    middle = RADIUS - 1e-4
    states = [[middle * np.sin(a), 0.013, middle * np.cos(a), 1, 0, 0, 0] for a in angles]
    check(model, [state(s, rng) for s in states], 8)


def test_a_sphere_on_edges_and_corners_of_a_ball() -> None:
    """Normals near those of the faces on both sides of edges, and beside corners."""
    rng = np.random.default_rng(0)
    points = ball(3)
    model = scene('type="mesh" mesh="hull"', mesh(points), f'size="{RADIUS}"')
    corners, first, count = model.mesh_vert, model.mesh_polyvertadr, model.mesh_polyvertnum
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    turn, origin = data.geom_xmat[0].reshape(3, 3), data.geom_xpos[0]
    states = []
    for face in rng.integers(0, model.mesh_polynum[0], 40):
        own = corners[model.mesh_polyvert[first[face] : first[face] + count[face]]]
        normal = model.mesh_polynormal[face]
        middle, along = 0.5 * (own[0] + own[1]), own[1] - own[0]
        outward = np.cross(along, normal) / np.linalg.norm(along)
        outward *= np.sign(outward @ (middle - own.mean(0)))
        for off, lean in ((0.0, 3e-4), (0.0, 8e-4), (-2e-5, 0.0)):
            place = middle + 0.4 * along * (1 - 2e-3 * rng.random()) + off * outward
            place = place + 0.098 * along * (off == 0.0)  # 2 thousandths of an edge from its corner
            centre = place + (RADIUS - 2e-4) * (normal + lean * outward) / np.hypot(1, lean)
            states.append(state([*(origin + turn @ centre), 1, 0, 0, 0], rng))
    check(model, states, 90)


def test_a_capsule_whose_side_meets_a_corner_and_is_clipped() -> None:
    """Its line crosses a corner of a ball, almost across an edge that ends there."""
    rng = np.random.default_rng(0)
    points = ball(4)
    model = scene('type="mesh" mesh="hull"', mesh(points), 'type="capsule" size=".04 .1"')
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    turn, origin = data.geom_xmat[0].reshape(3, 3), data.geom_xpos[0]
    states = []
    for k in rng.integers(0, model.nmeshvert, 24):
        corner = model.mesh_vert[k]
        gaps = np.linalg.norm(model.mesh_vert - corner, axis=1)
        edge = model.mesh_vert[np.argsort(gaps)[1]] - corner
        normal = corner / np.linalg.norm(corner)
        normal -= (normal @ edge / (edge @ edge) + rng.choice([1e-4, 3e-4, 1e-3]) / np.linalg.norm(edge)) * edge
        normal /= np.linalg.norm(normal)
        axis = edge / np.linalg.norm(edge) + rng.uniform(-1, 1) * np.cross(normal, edge) / np.linalg.norm(edge)
        axis -= (axis @ normal) * normal
        axis /= np.linalg.norm(axis)
        frame = np.column_stack([np.cross(normal, axis), normal, axis])
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, (turn @ frame).ravel())
        centre = corner + (0.04 - 2e-4) * normal + 0.03 * axis
        states.append(state([*(origin + turn @ centre), *quat], rng))
    check(model, states, 15)
