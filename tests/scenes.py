"""Small models that the gradient tests share."""

import mujoco
import numpy as np
from oracle import Point, rollout, tighten

_LEGS = "".join(
    f"""
      <body name="leg{i}" pos="{0.2 * x} {0.2 * y} 0">
        <joint name="hip{i}" type="hinge" axis="0 0 1" range="-40 40"/>
        <geom type="capsule" size="0.08" fromto="0 0 0 {0.2 * x} {0.2 * y} 0"/>
        <body pos="{0.2 * x} {0.2 * y} 0">
          <joint name="knee{i}" type="hinge" axis="{-y} {x} 0" range="{30 * s - 40} {30 * s + 40}"/>
          <geom type="capsule" size="0.08" fromto="0 0 0 {0.4 * x} {0.4 * y} 0"/>
        </body>
      </body>"""
    for i, (x, y, s) in enumerate([(1, 1, 1), (-1, 1, 1), (-1, -1, 1), (1, -1, 1)])
)


def ant(cone: str = "pyramidal", condim: int = 3) -> mujoco.MjModel:
    """Free torso and four legs of two hinges: nq 15, nv 14, nu 8."""
    motors = "".join(f'<motor joint="{j}{i}" gear="200"/>' for i in range(4) for j in ("hip", "knee"))
    return tighten(
        mujoco.MjModel.from_xml_string(
            f"""
<mujoco>
  <compiler angle="degree"/>
  <option timestep="{1 / 240}" integrator="Euler" solver="Newton" jacobian="dense" cone="{cone}"/>
  <default>
    <joint damping="11" armature=".05" limited="true" solreflimit="-122 -1.2" solimplimit=".9 .9 .01 .5 2"/>
    <geom density="1000" condim="{condim}" friction=".75 .1 .1" solref=".065 1" solimp=".9 .95 .01 .5 2"
          contype="0" conaffinity="1"/>
    <motor ctrllimited="true" ctrlrange="-1 1"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="40 40 1" contype="1" conaffinity="0"/>
    <body name="torso" pos="0 0 .75">
      <freejoint/>
      <geom type="sphere" size=".25"/>{_LEGS}
    </body>
  </worldbody>
  <actuator>{motors}</actuator>
</mujoco>"""
        )
    )


def cartpole() -> mujoco.MjModel:
    """A cart on a slide with a pole: nq 2, nu 1."""
    return tighten(
        mujoco.MjModel.from_xml_string(
            """
<mujoco>
  <option timestep="0.004167" integrator="Euler"/>
  <worldbody>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" damping=".1" armature=".01"/>
      <geom type="box" size=".2 .1 .1" mass="1"/>
      <body pos="0 0 0">
        <joint name="hinge" type="hinge" axis="0 1 0" damping=".05"/>
        <geom type="capsule" size=".04" fromto="0 0 0 0 0 1" mass=".5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slide" gear="100" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>"""
        )
    )


def ant_points(model: mujoco.MjModel, count: int, seed: int, settle: int = 160) -> list[Point]:
    """States of falling, landing and standing ants under random torques, most of them in contact."""
    rng = np.random.default_rng(seed)
    points = []
    for i in range(count):
        qpos = model.qpos0.copy()
        qpos[2] = 0.55 + 0.1 * rng.random()
        qpos[3:7] += 0.1 * rng.normal(size=4)
        qpos[3:7] /= np.linalg.norm(qpos[3:7])
        qpos[8::2] = np.radians(30) + 0.2 * rng.normal(size=4)
        qpos[7::2] = 0.2 * rng.normal(size=4)
        point = Point(qpos, 0.5 * rng.normal(size=model.nv), np.zeros(0), 0.2 * rng.normal(size=model.nu))
        data = rollout(model, point, 20 + settle * i // count)
        points.append(Point(data.qpos.copy(), data.qvel.copy(), np.zeros(0), 0.5 * rng.normal(size=model.nu)))
    return [
        # Rounded to float32, so that both sides start from the same numbers.
        Point(*(np.asarray(v, dtype=np.float32).astype(float) for v in (p.qpos, p.qvel, p.act, p.ctrl)))
        for p in points
    ]


def random_weights(model: mujoco.MjModel, count: int, seed: int) -> dict[str, np.ndarray]:
    """Cotangents of (qpos tangent, qvel, act) for `count` worlds."""
    rng = np.random.default_rng(seed)
    return {n: rng.normal(size=(count, k)) for n, k in (("qpos", model.nv), ("qvel", model.nv), ("act", model.na))}


def studded_plate() -> mujoco.MjModel:
    """A free plate with 64 spheres below, on which it lands, and 256 above: more contacts than a bound is taken for.

    It starts 20 cm above the ground, where nothing touches. mujoco_warp's own guess is room for 48 contacts and 64
    rows; lying, it makes 64 and 256.
    """

    def studs(side: int, height: float) -> str:
        places = np.linspace(-0.4, 0.4, side)
        return "".join(f'<geom size=".02" pos="{x} {y} {height}"/>' for x in places for y in places)

    return tighten(
        mujoco.MjModel.from_xml_string(
            f"""
<mujoco>
  <option timestep=".004"/>
  <default><geom contype="0" conaffinity="1" mass=".02" solref=".05 1"/></default>
  <worldbody>
    <geom type="plane" size="5 5 1" contype="1" conaffinity="0"/>
    <body pos="0 0 .25">
      <freejoint/>
      {studs(8, -0.03)}{studs(16, 0.03)}
      <site name="middle"/>
    </body>
  </worldbody>
  <actuator><motor site="middle" gear="0 0 1 0 0 0"/></actuator>
</mujoco>"""
        )
    )
