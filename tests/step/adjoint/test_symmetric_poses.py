"""Gradients at symmetric poses at rest, where a square root, a clamp or an axis of a collision function degenerates.

Every gradient is finite. Where gradcheck would not leave the state out (a kink, or a forward pass in MuJoCo Warp that
differs from C MuJoCo), it lies between the one-sided float64 differences of C MuJoCo.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np
import pytest

from msk_ray.step import Simulation, TapePerSubstep
from msk_ray.step.check import Limits, Oracle, Point, check_gradients
from msk_ray.step.check.check import forward_mismatch
from msk_ray.step.check.pullback import simulated_gradients

pytestmark = pytest.mark.long

EPS = 1e-6
DEPTH = 1e-3
"""How deep every pair of geometries penetrates [m]."""
SHAPES = {
    "sphere": 'type="sphere" size=".1"',
    "capsule": 'type="capsule" size=".06 .1"',
    "ellipsoid": 'type="ellipsoid" size=".1 .07 .12"',
    "cylinder": 'type="cylinder" size=".08 .1"',
    "box": 'type="box" size=".08 .07 .06"',
    "mesh": 'type="mesh" mesh="cube"',
}
CORNERS = [(x, y, z) for z in (-0.06, 0.06) for y in (-0.07, 0.07) for x in (-0.08, 0.08)]
CUBE = " ".join(str(v) for corner in CORNERS for v in corner)


def quat(x: float, y: float, z: float, degrees: float) -> np.ndarray:
    """Rotation about (x, y, z)."""
    out = np.zeros(4)
    axis = np.array([x, y, z], float)
    mujoco.mju_axisAngle2Quat(out, axis / np.linalg.norm(axis), math.radians(degrees))
    return out


def after(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """`second`, then `first`."""
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, first, second)
    return out


AS_IS, X90, Y90 = quat(1, 0, 0, 0), quat(1, 0, 0, 90), quat(0, 1, 0, 90)
EDGE, CORNER = quat(1, 0, 0, 45), quat(-0.07, 0.08, 0, math.degrees(math.atan2(math.hypot(0.08, 0.07), 0.06)))
EDGE_HEIGHT = (0.07 + 0.06) * math.sqrt(0.5)
CORNER_HEIGHT = math.sqrt(0.08**2 + 0.07**2 + 0.06**2)
HALF, THIRD = math.sqrt(0.5), math.sqrt(1 / 3)

Pose = tuple[tuple[float, float, float], np.ndarray]
ON_PLANE: dict[str, dict[str, Pose]] = {
    "sphere": {"rest": ((0, 0, 0.1), AS_IS)},
    "capsule": {
        "upright": ((0, 0, 0.16), AS_IS),
        "upside down": ((0, 0, 0.16), quat(1, 0, 0, 180)),
        "lying": ((0, 0, 0.06), Y90),
        "at the change of frame": ((0, 0, 0.06 + 0.1 * math.cos(math.radians(30))), quat(0, 1, 0, 30)),
    },
    "cylinder": {
        "upright": ((0, 0, 0.1), AS_IS),
        "upside down": ((0, 0, 0.1), quat(1, 0, 0, 180)),
        "turned": ((0, 0, 0.1), quat(0, 0, 1, 37)),
        "hardly tilted": ((0, 0, 0.1), quat(1, 0.3, 0, math.degrees(1e-6))),
        "lying": ((0, 0, 0.08), Y90),
        "lying across": ((0, 0, 0.08), X90),
    },
    "ellipsoid": {"z": ((0, 0, 0.12), AS_IS), "x": ((0, 0, 0.1), Y90), "y": ((0, 0, 0.07), X90)},
    "box": {
        "flat": ((0, 0, 0.06), AS_IS),
        "edge": ((0, 0, EDGE_HEIGHT), EDGE),
        "corner": ((0, 0, CORNER_HEIGHT), CORNER),
    },
    "mesh": {
        "flat": ((0, 0, 0.06), AS_IS),
        "edge": ((0, 0, EDGE_HEIGHT), EDGE),
        "corner": ((0, 0, CORNER_HEIGHT), CORNER),
    },
}
"""Poses of a shape on the plane."""

PAIRS: dict[tuple[str, str], dict[str, Pose]] = {
    ("sphere", "sphere"): {
        "above": ((0, 0, 0.2), AS_IS),
        "beside": ((0.2 - DEPTH, 0, DEPTH), AS_IS),
        "coincident": ((0, 0, DEPTH), AS_IS),
    },
    ("sphere", "capsule"): {
        "beside": ((0.16 - DEPTH, 0, DEPTH), AS_IS),
        "above": ((0, 0, 0.26), AS_IS),
        "at the end": ((0.16 - DEPTH, 0, 0.1 + DEPTH), AS_IS),
        "coincident": ((0, 0, DEPTH), AS_IS),
        "on the axis": ((0, 0, 0.05), AS_IS),
        "lying": ((0, 0, 0.16), Y90),
    },
    ("cylinder", "sphere"): {
        "cap": ((0, 0, 0.2), AS_IS),
        "side": ((0.18 - DEPTH, 0, 0), AS_IS),
        "rim": ((0.08 + 0.1 * HALF - DEPTH, 0, 0.1 + 0.1 * HALF), AS_IS),
        "level with the rim": ((0.18 - DEPTH, 0, 0.1 + DEPTH), AS_IS),
        "above the rim": ((0.08, 0, 0.2), AS_IS),
        "coincident": ((0, 0, DEPTH), AS_IS),
        "on the axis": ((0, 0, 0.05), AS_IS),
        "cap as near as side": ((0.03, 0, 0.05 + DEPTH), AS_IS),
    },
    ("box", "sphere"): {
        "face": ((0, 0, 0.16), AS_IS),
        "edge": ((0.08 + 0.1 * HALF - DEPTH, 0, 0.06 + 0.1 * HALF), AS_IS),
        "corner": ((0.08 + 0.1 * THIRD - DEPTH, 0.07 + 0.1 * THIRD, 0.06 + 0.1 * THIRD), AS_IS),
        "coincident": ((0, 0, DEPTH), AS_IS),
        "centre on the face": ((0, 0, 0.06 + DEPTH), AS_IS),
        "centre on the edge": ((0.08, 0, 0.06 + DEPTH), AS_IS),
        "centre on the corner": ((0.08, 0.07, 0.06 + DEPTH), AS_IS),
        "above the edge": ((0.08, 0, 0.16), AS_IS),
    },
    ("capsule", "capsule"): {
        "parallel": ((0.12 - DEPTH, 0, DEPTH), AS_IS),
        "antiparallel": ((0.12 - DEPTH, 0, DEPTH), quat(1, 0, 0, 180)),
        "parallel, shifted": ((0.12 - DEPTH, 0, 0.07), AS_IS),
        "parallel, end to end": ((0.12 - DEPTH, 0, 0.2 + DEPTH), AS_IS),
        "in line": ((0, 0, 0.32), AS_IS),
        "crossed": ((0.12 - DEPTH, 0, DEPTH), X90),
        "crossed, axes touch": ((0, 0, DEPTH), X90),
        "coincident": ((0, 0, DEPTH), AS_IS),
        "axes overlap": ((0, 0, 0.05), AS_IS),
        "end on the middle": ((0, 0, 0.22), Y90),
        "end on the end": ((0.1, 0, 0.22), Y90),
    },
    ("box", "capsule"): {
        "lying": ((0, 0, 0.12), Y90),
        "lying across": ((0, 0, 0.12), X90),
        "upright": ((0, 0, 0.22), AS_IS),
        "along an edge": ((0.08 + 0.06 * HALF - DEPTH, 0, 0.06 + 0.06 * HALF), X90),
        "across an edge": ((0.08 + 0.06 * HALF - DEPTH, 0, 0.06 + 0.06 * HALF), quat(0, 1, 0, -45)),
        "diagonal": ((0, 0, 0.12), after(quat(0, 0, 1, 45), Y90)),
        "half over the edge": ((0.08, 0, 0.12), Y90),
        "end at the edge": ((0.18, 0, 0.12), Y90),
        "coincident": ((0, 0, DEPTH), AS_IS),
    },
    ("box", "box"): {
        "aligned": ((0, 0, 0.12), AS_IS),
        "shifted": ((0.03, 0.02, 0.12), AS_IS),
        "turned by 45": ((0, 0, 0.12), quat(0, 0, 1, 45)),
        "turned by 90": ((0, 0, 0.12), quat(0, 0, 1, 90)),
        "edge on face": ((0, 0, 0.06 + EDGE_HEIGHT), EDGE),
        "corner on face": ((0, 0, 0.06 + CORNER_HEIGHT), CORNER),
        "edges meet": ((0.16 - DEPTH, 0, 0.12), AS_IS),
        "coincident": ((0, 0, DEPTH), AS_IS),
    },
    ("ellipsoid", "sphere"): {"pole": ((0, 0, 0.22), AS_IS), "pole x": ((0.2 - DEPTH, 0, DEPTH), AS_IS)},
    ("ellipsoid", "ellipsoid"): {"pole": ((0, 0, 0.24), AS_IS)},
    ("ellipsoid", "box"): {"pole": ((0, 0, 0.18), AS_IS)},
    ("ellipsoid", "capsule"): {"pole": ((0, 0, 0.18), Y90), "end": ((0, 0, 0.28), AS_IS)},
    ("ellipsoid", "cylinder"): {"pole": ((0, 0, 0.22), AS_IS)},
    ("cylinder", "cylinder"): {"stacked": ((0, 0, 0.2), AS_IS), "beside": ((0.16 - DEPTH, 0, DEPTH), AS_IS)},
    ("cylinder", "capsule"): {"upright": ((0, 0, 0.26), AS_IS), "lying": ((0, 0, 0.16), Y90)},
    ("cylinder", "box"): {"stacked": ((0, 0, 0.16), AS_IS), "beside": ((0.16 - DEPTH, 0, DEPTH), AS_IS)},
    ("mesh", "sphere"): {"face": ((0, 0, 0.16), AS_IS)},
    ("mesh", "capsule"): {"lying": ((0, 0, 0.12), Y90), "upright": ((0, 0, 0.22), AS_IS)},
    ("mesh", "cylinder"): {"stacked": ((0, 0, 0.16), AS_IS)},
    ("mesh", "box"): {"flat": ((0, 0, 0.12), AS_IS)},
    ("mesh", "mesh"): {"flat": ((0, 0, 0.12), AS_IS)},
    ("mesh", "ellipsoid"): {"pole": ((0, 0, 0.18), AS_IS)},
}
"""Poses of the second shape, the first at the origin. A pose that does not sit at `DEPTH` already is lowered by it."""

LEFT_OUT = {
    "sphere with sphere: coincident",
    *(f"sphere with capsule: {p}" for p in ("coincident", "on the axis")),
    *(f"cylinder with sphere: {p}" for p in ("above the rim", "coincident", "cap as near as side")),
    *(f"box with sphere: {p}" for p in ("coincident", "centre on the edge", "centre on the corner")),
    *(f"capsule with capsule: {p}" for p in ("crossed, axes touch", "coincident", "axes overlap")),
    *(f"box with capsule: {p}" for p in ("lying", "diagonal", "end at the edge")),
    *(f"box with box: {p}" for p in ("aligned", "turned by 45", "edges meet", "coincident")),
    *(f"ellipsoid with {other}: pole" for other in ("box", "cylinder", "ellipsoid")),
    *(f"cylinder with {other}: {p}" for other in ("box", "cylinder") for p in ("beside", "stacked")),
    *("mesh with cylinder: stacked", "mesh with ellipsoid: pole", "mesh with mesh: flat"),
}
"""Poses that gradcheck leaves out: the normal has no direction there, the number of contacts changes, or MuJoCo's
convex collision stops at another of its approximations of a curved surface."""

LEFT_OUT_WITHOUT_NATIVE = {
    *(f"{shape} with capsule: {p}" for shape in ("cylinder", "mesh") for p in ("lying", "upright")),
    *("mesh with box: flat", "mesh with sphere: face", "ellipsoid with capsule: pole"),
}
"""Those too where C MuJoCo collides with libccd, which MuJoCo Warp does not have."""

ROUGH = {
    "capsule with capsule: parallel": 2e-3,
    "capsule with capsule: antiparallel": 2e-3,
    "box with capsule: across an edge": 1e-2,
    "box with box: shifted": 1e-2,
    "box with box: turned by 45": 1e-2,
    "box with box: turned by 90": 1e-2,
    "box with box: edge on face": 1e-2,
    "mesh with box: flat": 1e-2,
}
"""Where two features end side by side, so that a contact moves with either body: the gradient follows one of them."""


def free_bodies(plane: bool, option: str, flag: str) -> mujoco.MjModel:
    """Two free bodies of each shape, or one of each above a plane."""
    ground = '<geom type="plane" size="5 5 1"/>' if plane else ""
    bodies = "".join(
        f'<body name="{shape}{i}"><freejoint/><geom {attributes}/></body>'
        for shape, attributes in SHAPES.items()
        for i in range(1 if plane else 2)
    )
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep=".004" ccd_tolerance="1e-10" {option}><flag {flag}/></option>
        <default><geom condim="3" friction=".6 .02 .01" solref=".05 1" solimp=".8 .9 .05 .5 2"/></default>
        <asset><mesh name="cube" vertex="{CUBE}"/></asset><worldbody>{ground}{bodies}</worldbody></mujoco>"""
    )


def placed(model: mujoco.MjModel, poses: dict[str, Pose]) -> Point:
    """Everything at rest: the named bodies at their poses, every other one high up and far from the next."""
    qpos = model.qpos0.copy()
    for body in range(1, model.nbody):
        start = model.jnt_qposadr[model.body_jntadr[body]]
        where, turn = poses.get(model.body(body).name, ((0.0, 2.0 * body, 5.0), AS_IS))
        qpos[start : start + 7] = [*where, *turn]
    return Point(*(np.asarray(v, np.float32).astype(float) for v in ([], qpos, np.zeros(model.nv), [])))


def lowered(pose: Pose) -> Pose:
    (x, y, z), turn = pose
    return (x, y, z - DEPTH), turn


def sides(oracle: Oracle, point: Point, cotangent: np.ndarray, name: str, column: int) -> tuple[float, float]:
    """⟨cotangent, result⟩ by one input, from below and from above."""
    end = oracle.step(point)
    moved = (oracle.difference(end, oracle.step(oracle.displaced(point, name, column, e))) / e for e in (-EPS, EPS))
    below, above = (float(cotangent @ change) for change in moved)
    return below, above


def check(
    model: mujoco.MjModel, points: Sequence[Point], names: Sequence[str], columns: Sequence[Sequence[int]]
) -> set[str]:
    """Check one state a world, those beyond the last `columns` for finite numbers only.

    Args:
        columns: degrees of freedom looked at in each world.

    Returns:
        The states that gradcheck would leave out.
    """
    sim = Simulation(model, len(points), 1, TapePerSubstep(), "cpu", tolerance=1e-9)
    oracle, limits = Oracle(model, 1), Limits()
    rng = np.random.default_rng(0)
    cotangents = rng.standard_normal((len(points), 2 * model.nv + model.na)).astype(np.float32).astype(float)
    ends, gradients = simulated_gradients(sim, points, cotangents)
    for name, gradient in gradients.items():
        lost = [state for state, row in zip(names, gradient, strict=True) if not np.isfinite(row).all()]
        assert not lost, f"the gradient by {name} is not finite: {lost}"
    left_out = set()
    for world, own in enumerate(columns):
        point = points[world]
        reference = oracle.linearize(point)
        if forward_mismatch(oracle, point, reference.end, ends[world]) > limits.forward_mismatch or reference.at_kink(
            limits.step_disagreement, limits.side_disagreement
        ):
            left_out.add(names[world])
            continue
        for name, expected in reference.pull_back(cotangents[world]).items():
            looked_at = list(own) if name in ("qpos", "qvel") else list(range(len(expected)))
            slack = ROUGH.get(names[world], 1e-3) * float(np.linalg.norm(expected[looked_at])) + 1e-6
            for column in looked_at:
                bounds = sides(oracle, point, cotangents[world], name, column)
                found = gradients[name][world][column]
                assert min(bounds) - slack <= found <= max(bounds) + slack, f"{names[world]}: {name} {column}"
    return left_out


def dofs(model: mujoco.MjModel, *bodies: str) -> list[int]:
    """Degrees of freedom of free bodies."""
    return [int(model.body(b).dofadr[0]) + i for b in bodies for i in range(6)]


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_on_a_plane(cone: str) -> None:
    model = free_bodies(True, f'cone="{cone}"', "")
    cases = [(shape, name, pose) for shape, poses in ON_PLANE.items() for name, pose in poses.items()]
    points = [placed(model, {f"{shape}0": lowered(pose)}) for shape, _, pose in cases]
    names = [f"{shape}: {name}" for shape, name, _ in cases]
    assert check(model, points, names, [dofs(model, f"{shape}0") for shape, _, _ in cases]) == set()


@pytest.mark.parametrize(("cone", "flag"), [("elliptic", ""), ("pyramidal", 'nativeccd="disable"')])
def test_in_pairs(cone: str, flag: str) -> None:
    model = free_bodies(False, f'cone="{cone}"', flag)
    cases = [(first, second, name, pose) for (first, second), poses in PAIRS.items() for name, pose in poses.items()]
    points = [placed(model, {f"{a}0": ((0, 0, 0), AS_IS), f"{b}1": lowered(pose)}) for a, b, _, pose in cases]
    names = [f"{a} with {b}: {name}" for a, b, name, _ in cases]
    left_out = check(model, points, names, [dofs(model, f"{a}0", f"{b}1") for a, b, _, _ in cases])
    assert left_out <= (LEFT_OUT | LEFT_OUT_WITHOUT_NATIVE if flag else LEFT_OUT)


BALL = """<body pos="0 0 1"><joint name="j" type="ball" {}/><geom type="capsule" size=".05" fromto="0 0 0 .1 .2 .1"/>
</body>"""
FREE = """<body name="f" pos="0 0 1"><freejoint name="j"/><geom type="box" size=".1 .2 .3"/><site name="b"/></body>"""
ARM = """<body pos="0 0 1"><joint name="a" axis="0 1 0" {}/>
<geom type="capsule" size=".05" fromto="0 0 0 .3 0 0"/>
<geom name="ball" type="sphere" size=".06" pos=".3 0 0"/><geom name="rod" type="cylinder" size=".05 .1" pos=".3 0 0"
euler="90 0 0"/><site name="s0" pos=".1 0 0"/><site name="s1" pos=".2 0 0"/><site name="s1b" pos=".2 0 0"/>
<site name="up0" pos=".15 0 .06"/><site name="end" pos=".3 0 0"/>
<body pos=".3 0 0"><joint name="c" axis="0 1 0" {}/><geom type="capsule" size=".04" fromto="0 0 0 .3 0 0"/>
<site name="start"/><site name="s2" pos=".15 0 0"/><site name="up2" pos=".15 0 .06"/></body></body>
<body pos="0 0 1"><joint axis="0 1 0"/><geom size=".05" pos=".3 0 0"/><site name="beside" pos=".1 0 0"/></body>"""
SERVO = '<actuator><general tendon="t" gainprm="30" biastype="affine" biasprm="2 -20 -3"/></actuator>'
MUSCLE = '<actuator><muscle tendon="t" force="60" lengthrange=".1 .9" tausmooth=".2"/></actuator>'


def tendon(path: str, attributes: str = 'stiffness="50"', actuator: str = SERVO) -> str:
    """A tendon through sites, and around geoms named with a bar before them, on the stretched arm."""
    places = "".join(f'<geom geom="{p[1:]}"/>' if p[0] == "|" else f'<site site="{p}"/>' for p in path.split())
    ends = f'<tendon><spatial name="t" {attributes}>{places}</spatial></tendon>{actuator}'
    return f"<worldbody>{ARM.format('', '')}</worldbody>{ends}"


def body(kind: str, rest: str = "") -> str:
    return f"<worldbody>{kind}</worldbody>{rest}"


FEATURES: dict[str, tuple[str, bool]] = {
    "ball": (body(BALL.format("")), True),
    "ball, spring and damper": (body(BALL.format('stiffness="4" damping="1"')), True),
    "ball, friction loss": (body(BALL.format('frictionloss=".1"')), True),
    "ball, limit": (body(BALL.format('range="0 20" limited="true"')), True),
    "ball, active limit": (body(BALL.format('range="0 20" limited="true" margin="25"')), False),
    "ball, servo": (
        body(
            BALL.format(""),
            '<actuator><position joint="j" gear="1 2 1" kp="3"/><position jointinparent="j" kp="2"/></actuator>',
        ),
        True,
    ),
    "free": (
        body(FREE, '<actuator><position joint="j" gear="1 2 3 4 5 6"/><motor site="b" gear="1 2 3 4 5 6"/></actuator>'),
        True,
    ),
    "connect": (body(FREE, '<equality><connect body1="f" body2="world" anchor="0 0 .3"/></equality>'), True),
    "weld": (body(FREE, '<equality><weld body1="f"/></equality>'), True),
    "hinges, equality": (
        body(ARM.format("", ""), '<equality><joint joint1="a" joint2="c" polycoef="0 1 0 0 0"/></equality>'),
        True,
    ),
    "hinges, limit and friction": (body(ARM.format('range="0 40" limited="true"', 'frictionloss="3"')), True),
    "tendon, straight": (tendon("s0 s1 s2"), True),
    "tendon, spring at rest": (tendon("up0 up2"), True),
    "tendon, sites coincide on a body": (tendon("s0 s1 s1b s2"), True),
    "tendon, sites coincide on a joint's axis": (tendon("end start"), True),
    "tendon, sites coincide": (tendon("s0 beside s2"), False),
    "tendon, through a sphere's centre": (tendon("s0 |ball s2"), False),
    "tendon, touches a sphere": (tendon("up0 |ball up2"), False),
    "tendon, past a cylinder": (tendon("up0 |rod up2"), True),
    "tendon, limit": (tendon("up0 up2", 'range="0 .35" limited="true"', ""), True),
    "tendon, muscle at rest": (tendon("up0 up2", "", MUSCLE), False),
}
"""MJCF by name, and whether its reference configuration at rest, without control, is free of kinks."""


@pytest.mark.parametrize("name", FEATURES)
def test_features_at_rest(name: str) -> None:
    xml, compared = FEATURES[name]
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep=".004"/><default><geom contype="0" conaffinity="0"/></default>{xml}</mujoco>"""
    )
    rest = Point(
        np.zeros(model.nu), model.qpos0.astype(np.float32).astype(float), np.zeros(model.nv), np.zeros(model.na)
    )
    left_out = check(model, [rest], [name], [range(model.nv)])
    assert not (compared and left_out)


LINKS = """
<mujoco>
  <default><geom type="capsule" size=".01"/><joint type="ball" damping=".005"/></default>
  <worldbody>
    <geom fromto="0 0 0 0 0 .1"/>
    <body pos="0 0 .1">
      <joint/>
      <geom fromto="0 0 0 0 .1 .1"/>
      <body pos="0 .1 .1"><joint/><geom fromto="0 0 0 0 .1 0"/></body>
    </body>
  </worldbody>
</mujoco>"""


def test_capsules_that_share_an_end_have_no_slope_of_a_normal_that_is_rounding() -> None:
    """Links drawn from joint to joint, of which the first belongs to the world and collides with the second."""
    sim = Simulation(mujoco.MjModel.from_xml_string(LINKS), 4, 1, tolerance=1e-9)
    check = check_gradients(sim, states=["standing", "contact"])
    assert check.checked == 8
    assert check.max_rel_error < 1e-3
