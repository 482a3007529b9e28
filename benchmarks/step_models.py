"""Models of the step benchmark, from small to humanoid-size and muscle-driven."""

from collections.abc import Callable

import mujoco
import numpy as np

_HEAD = """
<mujoco>
  <compiler angle="degree"/>
  <option timestep="{timestep}" integrator="Euler" solver="Newton" cone="{cone}"/>
  <default>
    <joint damping="{damping}" armature=".05" limited="true" solreflimit="-122 -1.2" solimplimit=".9 .9 .01 .5 2"/>
    <geom density="1000" friction=".75 .1 .1" solref=".065 1" solimp=".9 .9 .01 .5 2" contype="0" conaffinity="1"/>
    <motor ctrllimited="true" ctrlrange="-1 1"/>
  </default>
  <worldbody>
    <geom type="plane" size="40 40 1" contype="1" conaffinity="0"/>
"""


def cartpole() -> mujoco.MjModel:
    """A cart with a pole: no contact."""
    text = _HEAD.format(timestep=1 / 240, cone="pyramidal", damping=0.1) + (
        """<body pos="0 0 1"><joint name="j" type="slide" axis="1 0 0" limited="false"/>
        <geom type="sphere" size=".1" conaffinity="0"/>
        <body><joint type="hinge" axis="0 1 0" limited="false"/>
        <geom type="capsule" size=".04" fromto="0 0 0 0 0 1" conaffinity="0"/></body></body></worldbody>
        <actuator><motor joint="j" gear="100"/></actuator></mujoco>"""
    )
    return mujoco.MjModel.from_xml_string(text)


def ant(cone: str = "pyramidal") -> mujoco.MjModel:
    """Free torso, four legs of two hinges: nv 14."""
    legs = "".join(
        f"""<body pos="{0.2 * x} {0.2 * y} 0">
        <joint name="hip{i}" axis="0 0 1" range="-40 40"/>
        <geom type="capsule" size=".08" fromto="0 0 0 {0.2 * x} {0.2 * y} 0"/>
        <body pos="{0.2 * x} {0.2 * y} 0"><joint name="knee{i}" axis="{-y} {x} 0" range="-10 70"/>
        <geom type="capsule" size=".08" fromto="0 0 0 {0.4 * x} {0.4 * y} 0"/></body></body>"""
        for i, (x, y) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    )
    motors = "".join(f'<motor joint="{j}{i}" gear="200"/>' for i in range(4) for j in ("hip", "knee"))
    text = _HEAD.format(timestep=1 / 240, cone=cone, damping=11) + (
        f"""<body pos="0 0 .5"><freejoint/><geom type="sphere" size=".25"/>{legs}</body></worldbody>
        <actuator>{motors}</actuator></mujoco>"""
    )
    return mujoco.MjModel.from_xml_string(text)


def biped() -> mujoco.MjModel:
    """A humanoid-size tree: trunk, two arms and two legs of spheres and capsules, nv 27."""

    def limb(name: str, at: str, first: tuple[str, ...], second: tuple[str, ...], length: float) -> str:
        joints = [
            "".join(f'<joint name="{name}{part}{k}" axis="{axis}" range="-60 60"/>' for k, axis in enumerate(axes))
            for part, axes in (("a", first), ("b", second))
        ]
        return f"""<body pos="{at}">{joints[0]}<geom type="capsule" size=".05" fromto="0 0 0 0 0 {-length}"/>
        <body pos="0 0 {-length}">{joints[1]}<geom type="capsule" size=".045" fromto="0 0 0 0 0 {-length}"/>
        <geom type="sphere" size=".07" pos=".03 0 {-length}"/></body></body>"""

    x, y, z = "1 0 0", "0 1 0", "0 0 1"
    limbs = {
        "right_leg": ("0 -.1 -.1", (x, y, z), (y, x), 0.4),
        "left_leg": ("0 .1 -.1", (x, y, z), (y, x), 0.4),
        "right_arm": ("0 -.2 .4", (x, y, z), (y,), 0.28),
        "left_arm": ("0 .2 .4", (x, y, z), (y,), 0.28),
    }
    trunk = f"""<body pos="0 0 1"><freejoint/><geom type="sphere" size=".12"/>
    {limb("right_leg", *limbs["right_leg"])}{limb("left_leg", *limbs["left_leg"])}
    <body pos="0 0 .1"><joint name="waist0" axis="{x}" range="-30 30"/><joint name="waist1" axis="{y}" range="-30 30"/>
    <joint name="waist2" axis="{z}" range="-30 30"/><geom type="capsule" size=".1" fromto="0 0 .1 0 0 .4"/>
    {limb("right_arm", *limbs["right_arm"])}{limb("left_arm", *limbs["left_arm"])}</body></body></worldbody>"""
    names = [f"waist{k}" for k in range(3)]
    for limb_name, (_, first, second, _) in limbs.items():
        names += [f"{limb_name}a{k}" for k in range(len(first))] + [f"{limb_name}b{k}" for k in range(len(second))]
    motors = "".join(f'<motor joint="{n}" gear="80"/>' for n in names)
    head = _HEAD.format(timestep=1 / 240, cone="pyramidal", damping=2)
    return mujoco.MjModel.from_xml_string(f"{head}{trunk}<actuator>{motors}</actuator></mujoco>")


def muscle_arms(arms: int = 4) -> mujoco.MjModel:
    """Two-joint arms of six muscles each, half of them wrapped around the elbow: nv 3 and nu 6 an arm."""
    bodies, tendons, muscles = "", "", ""
    for k in range(arms):
        bodies += f"""<body pos="0 {0.5 * k} 1"><joint axis="0 1 0" range="-90 90"/><joint axis="1 0 0" range="-60 60"/>
        <geom type="capsule" size=".04" fromto="0 0 0 .3 0 0"/>
        <geom name="elbow{k}" type="cylinder" size=".045 .05" pos=".3 0 0" euler="90 0 0" density="1"/>
        <site name="a{k}" pos=".05 0 .06"/><site name="b{k}" pos=".05 0 -.06"/><site name="side{k}" pos=".3 0 .1"/>
        <body pos=".3 0 0"><joint axis="0 1 0" range="-120 120"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/><site name="c{k}" pos=".1 0 .04"/>
        <site name="d{k}" pos=".1 0 -.04"/></body></body><site name="e{k}" pos="0 {0.5 * k} 1.1"/>
        <site name="f{k}" pos="0 {0.5 * k} .9"/>"""
        paths = [
            (f"a{k}", f"c{k}", f'<geom geom="elbow{k}" sidesite="side{k}"/>'),
            (f"b{k}", f"d{k}", ""),
            (f"e{k}", f"a{k}", ""),
            (f"f{k}", f"b{k}", ""),
            (f"e{k}", f"c{k}", f'<geom geom="elbow{k}" sidesite="side{k}"/>'),
            (f"f{k}", f"d{k}", f'<geom geom="elbow{k}"/>'),
        ]
        for i, (start, end, geom) in enumerate(paths):
            name = f"m{k}_{i}"
            tendons += f'<spatial name="{name}"><site site="{start}"/>{geom}<site site="{end}"/></spatial>'
            muscles += f'<muscle tendon="{name}" force="300" range=".7 1.2" lengthrange=".05 .5" tausmooth=".2"/>'
    text = _HEAD.format(timestep=0.002, cone="elliptic", damping=0.3)
    return mujoco.MjModel.from_xml_string(
        f"{text}{bodies}</worldbody><tendon>{tendons}</tendon><actuator>{muscles}</actuator></mujoco>"
    )


def quadruped() -> mujoco.MjModel:
    """A walking robot as large as a Go1 (nv 18) that stops its solver early, as models made for MJX do."""
    legs = "".join(
        f"""<body pos="{0.188 * x} {0.047 * y} 0"><inertial pos="0 0 0" mass=".68" diaginertia="5e-4 5e-4 5e-4"/>
        <joint name="roll{i}" axis="1 0 0" range="-.86 .86"/><body pos="0 {0.08 * y} 0">
        <inertial pos="0 0 -.03" mass="1" diaginertia="5e-3 5e-3 9e-4"/>
        <joint name="hip{i}" axis="0 1 0" range="-.69 4.5"/><body pos="0 0 -.213">
        <inertial pos="0 0 -.1" mass=".2" diaginertia="3e-3 3e-3 4e-5"/>
        <joint name="knee{i}" axis="0 1 0" range="-2.8 -.89"/>
        <geom size=".023" pos="0 0 -.213" contype="0" conaffinity="1" solimp=".9 .95 .023"/></body></body></body>"""
        for i, (x, y) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    )
    motors = "".join(f'<position joint="{j}{i}" kp="35"/>' for i in range(4) for j in ("roll", "hip", "knee"))
    pose = 4 * "0 .9 -1.8 "
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler autolimits="true"/><option timestep=".004" iterations="1" ls_iterations="5">
        <flag eulerdamp="disable"/></option><default><joint damping=".5" armature=".005" frictionloss=".1"/></default>
        <worldbody><geom type="plane" size="9 9 1" priority="1" friction=".6"/>
        <body pos="0 0 .28"><freejoint/><inertial pos="0 0 0" mass="5.2" diaginertia=".017 .06 .065"/>{legs}</body>
        </worldbody><actuator>{motors}</actuator>
        <keyframe><key qpos="0 0 .278 1 0 0 0 {pose}" ctrl="{pose}"/></keyframe></mujoco>"""
    )


def heap(shape: str) -> mujoco.MjModel:
    """Six free bodies dropped into a tray of boxes: boxes, or meshes of 400 corners."""
    spread = np.random.default_rng(0).normal(size=(400, 3))
    corners = " ".join(f"{x:.5f}" for x in (0.1 * spread / np.linalg.norm(spread, axis=1)[:, None]).ravel())
    geom = {"box": 'type="box" size=".1 .08 .06"', "mesh": 'type="mesh" mesh="pebble"'}[shape]
    bodies = "".join(f'<body pos="{0.01 * k} 0 {0.2 + 0.22 * k}"><freejoint/><geom {geom}/></body>' for k in range(6))
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep=".002" cone="elliptic"/><asset><mesh name="pebble" vertex="{corners}"/></asset>
        <worldbody><geom type="box" size=".5 .5 .05"/><geom type="box" size=".05 .5 .3" pos=".3 0 .3"/>
        <geom type="box" size=".05 .5 .3" pos="-.3 0 .3"/><geom type="box" size=".5 .05 .3" pos="0 .3 .3"/>
        <geom type="box" size=".5 .05 .3" pos="0 -.3 .3"/>{bodies}</worldbody></mujoco>"""
    )


MODELS: dict[str, Callable[[], mujoco.MjModel]] = {
    "cartpole": cartpole,
    "ant": ant,
    "ant_elliptic": lambda: ant("elliptic"),
    "biped": biped,
    "muscle_arms": muscle_arms,
    "heap_of_boxes": lambda: heap("box"),
    "heap_of_meshes": lambda: heap("mesh"),
}
