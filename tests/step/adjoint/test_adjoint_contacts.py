"""Gradients through contact, one pair of geometries and one contact dimension each."""

import mujoco
import numpy as np
import pytest
from needs import slow
from oracle import Point, rollout, tighten
from test_adjoint_features import compare

_SHAPES = {
    "sphere": 'type="sphere" size=".1"',
    "capsule": 'type="capsule" size=".06 .1"',
    "ellipsoid": 'type="ellipsoid" size=".1 .07 .12"',
    "cylinder": 'type="cylinder" size=".08 .1"',
    "box": 'type="box" size=".08 .07 .06"',
    "mesh": 'type="mesh" mesh="wedge"',
}
_HILLS = " ".join(f"{h:.2f}" for h in np.random.default_rng(4).uniform(0, 1, 30))
_ASSETS = f'''<asset><hfield name="hills" nrow="5" ncol="6" size=".6 .5 .1 .05" elevation="{_HILLS}"/>
<mesh name="wedge" vertex="-.1 -.08 -.05 .1 -.08 -.05 0 .1 -.05 0 0 .12"/></asset>'''


_FIXED = {"plane": '<geom type="plane" size="5 5 1"/>', "hills": '<geom type="hfield" hfield="hills"/>'}


def falling(shape: str, ground: str, cone: str = "elliptic", condim: int = 3, option: str = "") -> mujoco.MjModel:
    """A free body of one shape above a plane or hills, or above a second shape that swings on two hinges."""
    below = (
        _FIXED[ground]
        if ground in _FIXED
        else f"""<body pos="0 0 -.3"><joint axis="1 0 0" pos="0 0 -.3" damping="1"/><joint axis="0 1 0" pos="0 0 -.3"
        damping="1"/><geom {_SHAPES[ground]} euler="20 70 10"/></body>"""
    )
    top = _SHAPES[shape]
    return tighten(
        mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep=".004" ccd_tolerance="1e-10" cone="{cone}" {option}/>
            <default><geom condim="{condim}" friction=".6 .02 .01" solref=".05 1" solimp=".8 .9 .05 .5 2"/></default>
            {_ASSETS}<worldbody>{below}<body pos="0 0 0"><freejoint/><geom {top}/>
            <geom type="sphere" size=".02" pos=".2 .1 .05" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
        )
    )


def landing_points(model: mujoco.MjModel, count: int, on_plane: bool) -> list[Point]:
    """States that touch: each is dropped from a random pose until it has been in contact for some steps."""
    rng = np.random.default_rng(3)
    points = []
    while len(points) < count:
        qpos = model.qpos0.copy()
        free = int(model.jnt_qposadr[model.njnt - 1])
        qpos[free : free + 3] = [0.03 * rng.normal(), 0.03 * rng.normal(), 0.25 if on_plane else 0.0]
        quat = rng.normal(size=4)
        qpos[free + 3 : free + 7] = quat / np.linalg.norm(quat)
        qvel = np.zeros(model.nv)
        dof = int(model.jnt_dofadr[model.njnt - 1])
        qvel[dof : dof + 6] = [*(0.3 * rng.normal(size=2)), -1.5, *(1.5 * rng.normal(size=3))]
        point = Point(qpos, qvel, np.zeros(0), np.zeros(0))
        touched = 0
        for _ in range(80):
            data = rollout(model, point, 1)
            touched += data.ncon > 0
            point = Point(data.qpos.copy(), data.qvel.copy(), np.zeros(0), np.zeros(0))
            if touched == 4:
                break
        if touched:
            points.append(Point(*(np.asarray(v, np.float32).astype(float) for v in (point.qpos, point.qvel, [], []))))
    return points


_PAIRS = [
    *[(shape, "plane") for shape in _SHAPES],
    *[("sphere", ground) for ground in ("sphere", "capsule", "cylinder", "box")],
    *[("capsule", ground) for ground in ("capsule", "box")],
    ("box", "box"),
    *[(shape, "hills") for shape in ("sphere", "capsule")],
    *[("mesh", "mesh"), ("mesh", "box"), ("ellipsoid", "mesh"), ("capsule", "mesh")],
]
_CHAINED = [("sphere", "plane"), ("box", "box"), ("capsule", "hills"), ("mesh", "box")]
"""Pairs of which `make test` chains substeps too."""


@pytest.mark.parametrize(
    ("shape", "ground", "substeps"),
    [
        *[(*pair, 1) for pair in _PAIRS],
        *[(*pair, 8) for pair in _CHAINED],
        *slow(*[(*pair, 8) for pair in _PAIRS if pair not in _CHAINED]),
    ],
)
def test_exact_pairs(shape, ground, substeps):
    model = falling(shape, ground)
    worst, kept = compare(model, landing_points(model, 6, ground in _FIXED), substeps)
    assert kept >= 2
    assert max(worst) < 1e-3


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize(
    ("condim", "option"),
    [
        *[(condim, "") for condim in (1, 3, 4, 6)],
        *[(6, 'impratio="3"'), (3, 'jacobian="sparse"')],
        *slow(*[(condim, 'impratio="3"') for condim in (1, 3, 4)]),
        *slow(*[(condim, 'jacobian="sparse"') for condim in (1, 4, 6)]),
    ],
)
def test_contact_dimensions(cone, condim, option):
    model = falling("sphere", "capsule", cone, condim, option)
    worst, kept = compare(model, landing_points(model, 5, False), 4)
    assert kept >= 2
    assert max(worst) < 1e-3


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_conjugate_gradient_solver(cone):
    model = falling("sphere", "capsule", cone, 3, 'solver="CG"')
    worst, kept = compare(model, landing_points(model, 5, False), 4)
    assert kept >= 2
    assert max(worst) < 1e-3
