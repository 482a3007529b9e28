"""Gradients of one feature each against float64 central differences of C MuJoCo, at 1 and 8 substeps."""

import mujoco
import numpy as np
import pytest
from needs import slow
from oracle import INPUTS, Point, differences, relative, rollout, simulate, tighten
from scenes import random_weights

from msk_ray.step.autograd.tape import TapePerSubstep

ARM = """
<body name="upper" pos="0 0 1">
  <joint name="a" axis="0 1 0" {a}/><joint name="b" axis="1 0 0" {b}/>
  <geom type="capsule" size=".05" fromto="0 0 0 .3 0 0"/>
  <geom name="ball" type="sphere" size=".06" pos=".3 0 0" mass=".2"/>
  <geom name="rod" type="cylinder" size=".05 .1" pos=".25 0 0" euler="90 0 0" mass=".2"/>
  <site name="s0" pos=".05 0 .07"/><site name="s1" pos=".2 0 .09"/><site name="side" pos=".3 .0 .12"/>
  <site name="core" pos=".28 0 .01"/>
  <body name="fore" pos=".3 0 0">
    <joint name="c" axis="0 1 0" {c}/>
    <geom type="capsule" size=".04" fromto="0 0 0 .3 .05 0"/>
    <site name="s2" pos=".15 .02 .06"/><site name="s3" pos=".25 0 .05"/>
    <body name="hand" pos=".3 .05 0">
      <joint name="d" type="slide" axis="1 .2 0" {d}/>
      <geom type="box" size=".05 .04 .03"/>
      <site name="s4" pos=".02 .03 .04" euler="20 30 40"/>
    </body>
  </body>
</body>
<body name="other" pos="0 .6 1">
  <joint name="turn" type="ball" {ball}/>
  <geom type="capsule" size=".05" fromto="0 0 0 .1 .2 .1"/>
  <site name="s5" pos=".1 .1 .1"/>
</body>
<site name="fixed" pos="0 0 1.3"/>
"""


def scene(rest: str = "", option: str = "", world: str = "", **joints: str) -> mujoco.MjModel:
    """An arm of two hinges, a hinge and a slide, and a body on a ball joint; no contact."""
    filled = {name: joints.get(name, "") for name in ("a", "b", "c", "d", "ball")}
    return tighten(
        mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep=".004" {option}/><default><geom contype="0" conaffinity="0"/>
            <joint armature=".01" damping=".1"/></default>
            <worldbody>{ARM.format(**filled)}{world}</worldbody>{rest}</mujoco>"""
        )
    )


_PATH = '<spatial name="t" {}><site site="s0"/><site site="s1"/><site site="s2"/><site site="s3"/></spatial>'
_PULLEY = """<spatial name="t"><site site="fixed"/><site site="s1"/><pulley divisor="2"/><site site="s1"/>
<site site="s2"/><pulley divisor="2"/><site site="s0"/><site site="s3"/></spatial>"""
_SPHERE = '<spatial name="t"><site site="s0"/><geom geom="ball" {}/><site site="s2"/><site site="s3"/></spatial>'
_CYLINDER = '<spatial name="t"><site site="s1"/><geom geom="rod" {}/><site site="s3"/></spatial>'
_FIXED = '<fixed name="t" {}><joint joint="a" coef=".7"/><joint joint="c" coef="-.4"/></fixed>'
_PATH_P = _PATH.format("").replace('name="t"', 'name="p"')
_FIXED2 = '<fixed name="t2"><joint joint="b" coef="1"/><joint joint="d" coef="2"/></fixed>'


def _tendon(path: str, actuators: str = "", **kw: str) -> mujoco.MjModel:
    return scene(f"<tendon>{path}</tendon><actuator>{actuators}</actuator>", **kw)


_MUSCLE = '<muscle tendon="t" force="60" range=".6 1.1" lengthrange=".3 .7" tausmooth=".2" timeconst=".02 .06"/>'
_SERVO = '<general tendon="t" gainprm="30" biastype="affine" biasprm="2 -20 -3" gear="1.5"/>'
_REFSITE = """<actuator><general site="{}" refsite="{}" gear="3 1 -2 .5 .7 -1.3" biastype="affine" biasprm="1 -9 -.4"/>
</actuator>"""
_FAST = 'integrator="implicitfast"'
_RK4 = 'integrator="RK4"'
_WATER = ' density="500" viscosity="2" wind="1 2 -.5"'
_FREE = """<body pos="1 0 1"><freejoint/><geom type="box" size=".1 .2 .3" pos=".05 .1 0" euler="10 20 30"/>
<body pos="0 .1 .3"><geom size=".1"/><site name="grip" pos="0 .1 .1"/></body></body>"""

SCENES = {
    "plain": lambda: scene(),
    "no_implicit_damping": lambda: _without_eulerdamp(),
    "springs": lambda: scene(a='stiffness="3"', c='stiffness="5" springref="20"', d='stiffness="40"'),
    "ball_spring": lambda: scene(ball='stiffness="4"'),
    "friction_loss": lambda: scene(a='frictionloss=".3"', c='frictionloss="20"', d='frictionloss="1"'),
    "gravcomp": lambda: scene(world='<body gravcomp=".7" pos="1 0 1"><joint/><geom size=".1" pos=".2 0 0"/></body>'),
    "limits": lambda: scene(a='range="-1 1"', c='range="-2 2" solimplimit=".8 .95 .1 .4 3"'),
    "ball_limit": lambda: scene(ball='range="0 20" limited="true"'),
    "motor": lambda: scene('<actuator><motor joint="a" gear="3" ctrllimited="true" ctrlrange="-1 1"/></actuator>'),
    "position": lambda: scene('<actuator><position joint="c" kp="30" kv="2"/><velocity joint="d" kv="3"/></actuator>'),
    "affine_gain": lambda: scene(
        '<actuator><general joint="a" gaintype="affine" gainprm="3 2 -1" biastype="affine"'
        ' biasprm=".3 -4 -1"/></actuator>'
    ),
    "force_limit": lambda: scene(
        '<actuator><motor joint="a" gear="3" forcelimited="true" forcerange="-.2 .2"/><motor joint="c"/></actuator>'
    ),
    "joint_force_limit": lambda: scene(
        '<actuator><motor joint="a" gear="3"/><motor joint="c" gear="2"/></actuator>', a='actuatorfrcrange="-.5 .5"'
    ),
    "filter": lambda: scene('<actuator><general joint="a" dyntype="filter" dynprm=".05" gainprm="2"/></actuator>'),
    "filterexact": lambda: scene(
        '<actuator><general joint="a" dyntype="filterexact" dynprm=".02" gainprm="2" actearly="true"/></actuator>'
    ),
    "integrator": lambda: scene(
        '<actuator><intvelocity joint="a" kp="20" actrange="-1 1"/>'
        '<general joint="c" dyntype="integrator" gainprm="3"/></actuator>'
    ),
    "joint_muscle": lambda: scene(
        '<actuator><muscle joint="a" force="20" gear=".1" lengthrange="-.2 .2" tausmooth=".2"/></actuator>'
    ),
    "fixed_tendon": lambda: _tendon(_FIXED.format('stiffness="5" springlength=".1" damping=".6"'), _SERVO),
    "fixed_tendon_limit": lambda: _tendon(_FIXED.format('range="-.1 .1"')),
    "fixed_tendon_armature": lambda: _tendon(_FIXED.format('armature=".5" damping=".6"') + _FIXED2, _SERVO),
    "gravcomp_by_actuators": lambda: scene(
        '<actuator><motor joint="g"/></actuator>',
        world='<body gravcomp=".7" pos="1 0 1"><joint name="g" actuatorgravcomp="true"/><geom size=".1" pos=".2 0 0"/>'
        "</body>",
    ),
    "tendon_friction": lambda: _tendon(_FIXED.format('frictionloss=".2"') + _PATH_P),
    "site_tendon": lambda: _tendon(_PATH.format('stiffness="50" springlength=".2" damping="2"'), _SERVO),
    "site_tendon_limit": lambda: _tendon(_PATH.format('range="0 .25" limited="true"')),
    "site_tendon_friction": lambda: _tendon(_PATH.format('frictionloss="3"')),
    "pulley": lambda: _tendon(_PULLEY, _SERVO),
    "sphere_wrap": lambda: _tendon(_SPHERE.format(""), _SERVO),
    "sphere_wrap_side": lambda: _tendon(_SPHERE.format('sidesite="side"'), _SERVO),
    "cylinder_wrap": lambda: _tendon(_CYLINDER.format(""), _SERVO),
    "cylinder_wrap_side": lambda: _tendon(_CYLINDER.format('sidesite="side"'), _SERVO),
    "sphere_wrap_inside": lambda: _tendon(_SPHERE.format('sidesite="core"'), _SERVO),
    "cylinder_wrap_inside": lambda: _tendon(_CYLINDER.format('sidesite="core"'), _SERVO),
    "muscle": lambda: _tendon(_SPHERE.format('sidesite="side"'), _MUSCLE),
    "muscle_cylinder": lambda: _tendon(_CYLINDER.format(""), _MUSCLE),
    "equality_joint": lambda: scene(
        '<equality><joint joint1="a" joint2="c" polycoef=".1 .5 .2 -.1 .05"/><joint joint1="d" polycoef=".02 0 0 0 0"/>'
        "</equality>"
    ),
    "connect_world": lambda: scene(
        '<equality><connect body1="hand" body2="world" anchor=".05 .02 0" solref=".05 1" solimp=".5 .9 .3 .5 2"/>'
        "</equality>"
    ),
    "connect_bodies": lambda: scene(
        '<equality><connect body1="hand" body2="other" anchor=".05 .02 0" solref=".1 1"/></equality>'
    ),
    "connect_sites": lambda: scene(
        '<equality><connect site1="s4" site2="s1" solref=".1 1"/><joint joint1="a" polycoef=".1 0 0 0 0"/></equality>'
    ),
    "weld_world": lambda: scene('<equality><weld body1="hand" solref=".1 1" solimp=".5 .9 .6 .5 2"/></equality>'),
    "weld_bodies": lambda: scene(
        '<equality><weld body1="other" body2="hand" anchor=".1 .02 .03" relpose=".1 .2 -.3 .8 .3 .2 .4" '
        'torquescale=".3" solref=".1 1"/></equality>'
    ),
    "weld_sites": lambda: scene('<equality><weld site1="s4" site2="s5" solref=".1 1" torquescale="2"/></equality>'),
    "weld_mocap": lambda: scene(
        '<equality><weld body1="target" body2="hand" relpose=".1 .2 0 1 0 0 0" solref=".1 1"/></equality>',
        world='<body name="target" mocap="true" pos=".5 .1 1.2" quat=".9 .1 .2 .3"/>',
    ),
    "equality_tendon": lambda: scene(
        f"<tendon>{_FIXED.format('')}{_FIXED2}{_PATH_P}"
        '</tendon><equality><tendon tendon1="t" tendon2="t2" polycoef=".1 .5 .2 0 0"/><tendon tendon1="p"/>'
        '<tendon tendon1="t2" tendon2="p" polycoef="0 1 .5 0 0"/></equality>'
    ),
    "fast_plain": lambda: scene(option=_FAST),
    "fast_servo": lambda: scene(
        '<actuator><position joint="c" kp="30" kv="2"/><velocity joint="d" kv="3"/></actuator>', option=_FAST
    ),
    "fast_branching_spring": lambda: _tendon(
        '<spatial name="t" stiffness="50" springlength=".2"><site site="s4"/><site site="s5"/></spatial>',
        '<motor tendon="t"/>',
        option=_FAST,
    ),
    "fast_fixed_tendon": lambda: _tendon(_FIXED.format('stiffness="5" damping=".6"'), _SERVO, option=_FAST),
    "fast_site_tendon": lambda: _tendon(_PATH.format('damping="2"'), _SERVO, option=_FAST),
    "fast_affine_gain": lambda: scene(
        '<actuator><general joint="a" gaintype="affine" gainprm="3 2 -1" biastype="affine"'
        ' biasprm=".3 -4 -1"/></actuator>',
        option=_FAST,
    ),
    "fast_muscle": lambda: _tendon(_SPHERE.format('sidesite="side"'), _MUSCLE, option=_FAST),
    "ball_servo": lambda: scene('<actuator><position joint="turn" gear="1 .5 -.3" kp="5" kv=".5"/></actuator>'),
    "ball_in_parent": lambda: scene(
        '<actuator><general jointinparent="turn" gear="1 .5 -.3" gainprm="2" biastype="affine" biasprm="0 -5 -.5"/>'
        "</actuator>"
    ),
    "free_motor": lambda: scene(
        '<actuator><motor joint="f" gear="1 2 -1 .5 .3 .2"/>'
        '<motor jointinparent="f" gear="1 2 -1 .5 .3 .2"/></actuator>',
        world='<body pos="1 0 1"><freejoint name="f"/><geom type="box" size=".1 .2 .3"/></body>',
    ),
    "fast_spinning_free": lambda: _tendon(
        '<spatial name="t" stiffness="50" springlength=".2"><site site="fixed"/><site site="grip"/></spatial>',
        '<motor site="grip" gear="3 1 -2 .1 .2 -.3"/>',
        option=_FAST,
        world=_FREE,
    ),
    "fluid": lambda: scene(option=_WATER, world=_FREE),
    "fast_spinning_fluid": lambda: scene(option=_FAST + _WATER, world=_FREE),
    "rk4_spinning_free": lambda: scene(option=_RK4, world=_FREE, a='range="-1 1"', ball='stiffness="4"'),
    "rk4_muscle": lambda: _tendon(_SPHERE.format('sidesite="side"'), _MUSCLE, option=_RK4),
    "rk4_activations": lambda: scene(
        '<actuator><intvelocity joint="a" kp="20" actrange="-1 .6"/>'
        '<general joint="c" dyntype="filter" dynprm=".02" gainprm="2" actearly="true" actlimited="true" '
        'actrange="0 .5"/><general joint="d" dyntype="filter" dynprm=".05" gainprm="3"/></actuator>',
        option=_RK4,
    ),
    "site": lambda: scene(
        '<actuator><general site="s4" gear="3 1 -2 .1 .2 -.3" biastype="affine" biasprm="1 0 -.4"/></actuator>'
    ),
    "refsite": lambda: scene(_REFSITE.format("s4", "s1")),
    "refsite_in_another_tree": lambda: scene(_REFSITE.format("s5", "s4")),
    "fast_refsite": lambda: scene(_REFSITE.format("s4", "s1"), option=_FAST),
    "slider_crank": lambda: scene(
        '<actuator><general cranksite="s5" slidersite="s4" cranklength="1.4" gear="2" biastype="affine" '
        'biasprm="1 -9 -.4"/></actuator>'
    ),
    "fast_site": lambda: scene(
        '<actuator><general site="s4" gear="3 1 -2 .1 .2 -.3" biastype="affine" biasprm="1 0 -.4"/></actuator>',
        option=_FAST,
    ),
    "sparse": lambda: _tendon(_FIXED.format('range="-.1 .1"'), _SERVO, option='jacobian="sparse"'),
}


def _without_eulerdamp() -> mujoco.MjModel:
    model = scene()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    return model


def random_points(model: mujoco.MjModel, count: int, seed: int, spread: float = 0.4) -> list[Point]:
    """Random states, rounded to float32 so that both sides start from the same numbers."""
    rng = np.random.default_rng(seed)
    points = []
    for _ in range(count):
        qpos = model.qpos0.copy()
        mujoco.mj_integratePos(model, qpos, spread * rng.normal(size=model.nv), 1.0)
        values = (
            qpos,
            0.7 * rng.normal(size=model.nv),
            rng.uniform(0.2, 0.8, size=model.na),
            rng.uniform(0.1, 0.9, size=model.nu),
        )
        points.append(Point(*(np.asarray(v, dtype=np.float32).astype(float) for v in values)))
    return points


def compare(model: mujoco.MjModel, points: list[Point], substeps: int) -> tuple[list[float], int]:
    """Worst relative error by kept state (no kink, Warp forward agrees), and how many were kept."""
    weights = random_weights(model, len(points), 11)
    end, found, _ = simulate(model, TapePerSubstep(), points, substeps, weights)
    worst = []
    for i, point in enumerate(points):
        expected, kink = differences(model, point, substeps, {n: w[i] for n, w in weights.items()})
        ahead = float(np.abs(end.qvel[i].detach().numpy() - rollout(model, point, substeps).qvel).max())
        errors = {n: relative(found[n][i], expected[n]) for n in INPUTS}
        print(f"state {i}: kink {kink:.1e} forward {ahead:.1e}", {n: f"{e:.1e}" for n, e in errors.items()})
        if kink < 1e-2 and ahead < 1e-3:
            worst.append(max(errors.values()))
    return worst, len(worst)


def _wraps(model: mujoco.MjModel, point: Point) -> bool:
    """Whether a tendon's path touches its geom; a model without spatial tendons counts as wrapped."""
    data = mujoco.MjData(model)
    data.qpos[:] = point.qpos
    mujoco.mj_forward(model, data)
    return model.ntendon == 0 or bool(np.any(data.wrap_obj >= 0))


CHAINED = ("filter", "muscle", "plain", "rk4_muscle", "site_tendon", "sparse", "weld_bodies")
"""Scenes of which `make test` chains substeps too; all others take them through the same code."""


@pytest.mark.parametrize(
    ("name", "substeps"),
    [
        *[(name, 1) for name in sorted(SCENES)],
        *[pytest.param(name, 8, marks=pytest.mark.long) for name in CHAINED],
        *slow(*[(name, 8) for name in sorted(SCENES) if name not in CHAINED]),
    ],
)
def test_feature(name, substeps):
    model = SCENES[name]()
    points = random_points(model, 4, seed=5)
    if "wrap" in name or "muscle" in name:
        # Bend the elbow over its sphere and cylinder, or away from them, where the path is held inside.
        wrapped = 0
        for point in points:
            point.qpos[2] = np.float32(point.qpos[2] + (-0.5 if "inside" in name else 1.2))
            wrapped += _wraps(model, point)
        assert wrapped >= 2
    if "spinning" in name:
        for point in points:
            point.qvel[:] *= 8
    worst, kept = compare(model, points, substeps)
    assert kept >= 2
    assert max(worst) < 1e-3
