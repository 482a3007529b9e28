"""Derivatives of contacts of convex geoms against float64 central differences of C MuJoCo's collision detection.

Weighted sums of distance, point and normal of each contact, over all twelve displacements of two free bodies. MuJoCo
Warp's convex collision is a copy of C MuJoCo's, so one oracle serves all pairs but two boxes that lie on each other,
which `test_box_pairs` compares with MuJoCo Warp.
"""

from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from contact_pairs import PlacedContact, displaced, pulled, turned, whole_turned
from needs import slow

pytestmark = pytest.mark.long

CURVED_SHAPES = {"ellipsoid", "cylinder", "capsule"}
SHAPES = {
    "hfield": 'type="hfield" hfield="hills"',
    "sphere": 'type="sphere" size=".06"',
    "capsule": 'type="capsule" size=".04 .15"',
    "ellipsoid": 'type="ellipsoid" size=".1 .07 .12"',
    "cylinder": 'type="cylinder" size=".08 .1"',
    "box": 'type="box" size=".1 .07 .05"',
    "mesh": 'type="mesh" mesh="gem"',
    "pebble": 'type="mesh" mesh="pebble"',
}
GEM = (
    "-.1 -.08 -.05 .1 -.08 -.05 .1 .08 -.05 -.1 .08 -.05 -.07 -.06 .05 .08 -.05 .05 .06 .07 .05 -.06 .05 .05 "
    "0 0 .08 .13 0 0 -.12 .01 0"
)
SPREAD = np.random.default_rng(5).normal(size=(400, 3))
PEBBLE = " ".join(f"{x:.5f}" for x in (SPREAD / np.linalg.norm(SPREAD, axis=1)[:, None] * [0.1, 0.08, 0.05]).ravel())
"""400 corners, so that neighbouring faces lie within MuJoCo's 5° of each other."""
HILLS = " ".join(f"{h:.2f}" for h in np.random.default_rng(4).uniform(0, 1, 30))


def two_bodies(first: str, second: str, flag: str = "", margin: float = 0.0) -> mujoco.MjModel:
    """Two free geoms, in the order in which MuJoCo pairs them."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option ccd_tolerance="1e-16" ccd_iterations="400"><flag {flag}/></option>
        <default><geom margin="{margin}"/></default>
        <asset><mesh name="gem" vertex="{GEM}"/><mesh name="pebble" vertex="{PEBBLE}"/>
        <hfield name="hills" nrow="5" ncol="6" size=".3 .25 .1 .05" elevation="{HILLS}"/></asset>
        <worldbody><body><freejoint/><geom {SHAPES[first]}/></body>
        <body><freejoint/><geom {SHAPES[second]}/></body></worldbody></mujoco>"""
    )
    assert model.geom_type[0] <= model.geom_type[1]
    return model


class Step(NamedTuple):
    """A displacement for differences, and the second difference per displacement above which a kink lies in them."""

    size: float
    curved: float


FINE, COARSE = Step(1e-6, 1e-2), Step(3e-4, 0.3)
"""On curved surfaces C MuJoCo's normal is only known up to about 1e-7, which a displacement of 1e-6 would magnify."""


class Contact(NamedTuple):
    """One contact."""

    dist: float
    point: np.ndarray
    normal: np.ndarray


def contacts(data: mujoco.MjData, qpos: np.ndarray) -> list[Contact]:
    """Contacts of a pose."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(data.model, data)
    mujoco.mj_collision(data.model, data)
    return [Contact(c.dist, c.pos.copy(), c.frame[:3].copy()) for c in data.contact]


def slopes(
    data: mujoco.MjData, qpos: np.ndarray, contact: Contact, weight: np.ndarray, step: Step
) -> np.ndarray | None:
    """Differences of ⟨weight, contact⟩ over 12 displacements; None at a kink or where the contact comes or goes."""
    scores = []
    count = len(contacts(data, qpos))
    for moved in displaced(qpos, step.size):
        found = contacts(data, moved)
        if len(found) != count:
            return None
        same = min(found, key=lambda c: float(np.linalg.norm(c.point - contact.point)))
        scores.append(weight @ np.concatenate([[same.dist], same.point, same.normal]))
    pairs = np.array(scores).reshape(12, 2)
    curved = np.abs(pairs.sum(1) - 2 * weight @ np.concatenate([[contact.dist], contact.point, contact.normal]))
    slope = (pairs[:, 0] - pairs[:, 1]) / (2 * step.size)
    return slope if curved.max() < step.curved * step.size * max(1.0, 2 * np.abs(slope).max()) else None


def touching(data: mujoco.MjData, quats: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """The second body lowered onto the first until it is millimetres inside; the pair is then turned as a whole."""
    qpos = np.zeros(14)
    qpos[3:7], qpos[10:14] = quats
    qpos[7:9] = 0.04 * rng.normal(size=2)
    depth = rng.uniform(1e-4, 5e-3)
    for height in np.arange(0.35, 0.0, -1e-3):
        qpos[9] = height
        if (found := contacts(data, qpos)) and min(c.dist for c in found) < 0.0:
            qpos[9] -= depth
            break
    return whole_turned(qpos, rng.normal(size=3))


def compare(model: mujoco.MjModel, poses: list[np.ndarray], step: Step) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of all contacts that have differences, and whether each was found exact."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    rows, expected = [], []
    for qpos in poses:
        touching = contacts(data, qpos)
        places = (data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy(), data.xpos[1:].copy())
        for contact in touching:
            weight = np.concatenate([[3.0 * rng.normal()], rng.normal(size=6)])
            # Only the turn of the normal counts.
            weight[4:] -= (weight[4:] @ contact.normal) * contact.normal
            slope = slopes(data, qpos, contact, weight, step)
            if slope is not None:
                rows.append(PlacedContact(*places, 0, np.concatenate([[contact.dist], *contact[1:]]), weight))
                expected.append(slope)
    wrenches, exact = pulled(model, rows)
    errors = np.linalg.norm(wrenches - expected, axis=1) / np.linalg.norm(expected, axis=1)
    return errors, exact


def upright_or_lying(rng: np.random.Generator) -> np.ndarray:
    """A shape on one of its faces, caps or sides, turned about the vertical."""
    base = np.array([1.0, 0, 0, 0]) if rng.random() < 0.5 else np.array([np.sqrt(0.5), 0, np.sqrt(0.5), 0])
    return turned(base, np.array([0, 0, rng.uniform(0, 6.28)]))


@pytest.mark.parametrize("shape", [name for name in SHAPES if name not in ("hfield", "pebble")])
def test_a_contact_follows_a_height_field(shape: str) -> None:
    """A box or a mesh that MuJoCo stops pushing out of a prism before it is out counts as not exact."""
    data, rng = mujoco.MjData(two_bodies("hfield", shape)), np.random.default_rng(0)
    level = np.array([1.0, 0, 0, 0])
    poses = [touching(data, [level, turned(level, 3.0 * rng.normal(size=3))], rng) for _ in range(16)]
    flat = shape in ("box", "mesh")
    errors, exact = compare(data.model, poses, FINE if flat else Step(1e-4, 0.3))
    assert len(errors) >= 30
    assert np.mean(exact) > (0.6 if flat else 0.99)
    assert np.median(errors[exact]) < (1e-6 if flat else 3e-3)
    assert errors[exact].max() < (1e-3 if flat else 2e-2)


def test_a_sphere_on_edges_of_a_smooth_height_field() -> None:
    """Triangles at some hundredths of a radian, and normals that are nearly those of one of them."""
    rng, n = np.random.default_rng(0), 21
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    heights = np.round(1 - 0.4 * (x**2 + 0.7 * y**2 + 0.3 * x * y), 4)
    grid = 0.1 * (heights - heights.min()) / (heights.max() - heights.min())
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option ccd_tolerance="1e-16" ccd_iterations="400"/><asset>
        <hfield name="hill" nrow="{n}" ncol="{n}" size=".5 .5 .1 .05"
        elevation="{" ".join(map(str, heights.ravel()))}"/>
        </asset><worldbody><body><freejoint/><geom type="hfield" hfield="hill"/></body>
        <body><freejoint/><geom size=".05"/></body></worldbody></mujoco>"""
    )
    poses = []
    for _ in range(40):
        i, j = rng.integers(5, n - 6, 2)
        places = ((i, j), (i, j + 1), (i - 1, j), (i + 1, j + 1))
        corner, after, below, above = (np.array([0.05 * (b - 10), 0.05 * (a - 10), grid[a, b]]) for a, b in places)
        normals = [np.cross(after - corner, p - corner) for p in (above, below)]
        normals = [m * np.sign(m[2]) / np.linalg.norm(m) for m in normals]
        share = rng.choice([0.01, 0.03, 0.5, 0.97])
        normal = (1 - share) * normals[0] + share * normals[1]
        place = corner + rng.uniform(0.3, 0.7) * (after - corner)
        level = [1.0, 0, 0, 0]
        poses.append(np.array([0, 0, 0, *level, *(place + 0.04998 * normal / np.linalg.norm(normal)), *level]))
    errors, exact = compare(model, poses, FINE)
    assert len(errors) >= 30
    assert np.all(exact)
    assert errors.max() < 1e-3


PAIRS = [
    *[(a, b, "") for a, b in (("sphere", "mesh"), ("box", "mesh"), ("mesh", "mesh"), ("capsule", "mesh"))],
    *[(a, "pebble", "") for a in ("box", "pebble")],
    *[("cylinder", b, "") for b in ("cylinder", "box", "mesh")],
    *[("ellipsoid", b, "") for b in ("ellipsoid", "cylinder", "box", "mesh")],
    *[("capsule", b, "") for b in ("ellipsoid", "cylinder")],
    ("sphere", "ellipsoid", ""),
    ("box", "box", 'nativeccd="disable"'),
]
IN_ANY_POSE = [
    ("box", "mesh", ""),
    ("capsule", "mesh", ""),
    ("cylinder", "cylinder", ""),
    ("ellipsoid", "ellipsoid", ""),
]
"""Pairs that `make test` compares in random poses too, which meet corners and edges of flat shapes."""


@pytest.mark.parametrize(
    ("first", "second", "flag", "flush"),
    [
        *[(*pair, True) for pair in PAIRS],
        *[(*pair, False) for pair in IN_ANY_POSE],
        *slow(*[(*pair, False) for pair in PAIRS if pair not in IN_ANY_POSE]),
    ],
)
def test_a_contact_follows_both_bodies(first: str, second: str, flag: str, flush: bool) -> None:
    """In random poses, and with faces and sides that lie on each other, up to some degrees."""
    model = two_bodies(first, second, flag)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    poses = []
    for _ in range(16):
        if flush:
            quats = [upright_or_lying(rng) for _ in range(2)]
            quats[1] = turned(quats[1], np.array([*(0.02 * rng.normal(size=2)), 0.0]))
        else:
            quats = [turned(np.array([1.0, 0, 0, 0]), 3.0 * rng.normal(size=3)) for _ in range(2)]
        poses.append(touching(data, quats, rng))
    curved = {first, second} & CURVED_SHAPES and first != "box" and (first, second) != ("capsule", "mesh")
    errors, exact = compare(model, poses, COARSE if curved else FINE)
    print(f"{len(errors)} contacts, {np.sum(~exact)} not exact, {np.sort(errors[exact])[-5:]}")
    assert len(errors) >= 12
    # A cylinder's side on a face is clipped along a line through any rim point that MuJoCo's search has met;
    # a cap on a face never counts as exact.
    assert np.mean(exact) > (0.05 if first == "cylinder" else 0.99)
    assert np.median(errors[exact]) < (1e-3 if curved else 1e-6)
    assert errors[exact].max() < 1e-2
