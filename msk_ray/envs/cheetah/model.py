"""The cheetah: a torso on a hind and a fore leg in a vertical plane, in two named physics.

Measures, masses, springs and motors are those of the classic half-cheetah (Gymnasium's `half_cheetah.xml` for
`published`), and of DiffRL's, `envs/cheetah.py` and `envs/assets/half_cheetah.xml` of github.com/NVlabs/DiffRL, for
`matched`: as dense as water, with wider ranges of the fore leg, of which the foot starts outside its own, motors of
200 N m, and armature and dampers at the root too.
"""

import mujoco

from msk_ray.config import PhysicsConfig
from msk_ray.envs.cheetah.config import CheetahSettings
from msk_ray.envs.floor import HardContacts, SpringContacts, compile_on_floor

TORSO_HEIGHT = 1.0
"""Height of the torso in the reference configuration [m]."""

_MJCF = f"""
<mujoco model="cheetah">
  <compiler angle="radian"/>
  <default>
    <geom type="capsule" size="0.046" contype="0" conaffinity="0" density="1000" rgba="0.8 0.6 0.3 1"/>
    <default class="driven">
      <joint type="hinge" axis="0 1 0" limited="true" armature="0.1" solimplimit="0 0.8 0.03"/>
    </default>
    <motor ctrllimited="true" ctrlrange="-1 1"/>
  </default>
  <worldbody>
    <body name="torso" pos="0 0 {TORSO_HEIGHT}">
      <camera name="track" mode="trackcom" pos="0 -3 0.3" xyaxes="1 0 0 0 0 1"/>
      <light mode="trackcom" pos="0 0 4" dir="0 0 -1" type="directional"/>
      <joint name="root_x" type="slide" axis="1 0 0"/>
      <joint name="root_z" type="slide" axis="0 0 1"/>
      <joint name="root_pitch" type="hinge" axis="0 1 0"/>
      <geom name="torso" fromto="-0.5 0 0 0.5 0 0"/>
      <geom name="head" size="0.046 0.15" pos="0.6 0 0.1" axisangle="0 1 0 0.87"/>
      <body name="hind_thigh" pos="-0.5 0 0">
        <joint name="hind_thigh" class="driven" range="-0.52 1.05" stiffness="240" damping="6"/>
        <geom name="hind_thigh" size="0.046 0.145" pos="0.1 0 -0.13" axisangle="0 1 0 -3.8"/>
        <body name="hind_shin" pos="0.16 0 -0.25">
          <joint name="hind_shin" class="driven" range="-0.785 0.785" stiffness="180" damping="4.5"/>
          <geom name="hind_shin" size="0.046 0.15" pos="-0.14 0 -0.07" axisangle="0 1 0 -2.03"/>
          <body name="hind_foot" pos="-0.28 0 -0.14">
            <joint name="hind_foot" class="driven" range="-0.4 0.785" stiffness="120" damping="3"/>
            <geom name="hind_foot" size="0.046 0.094" pos="0.03 0 -0.097" axisangle="0 1 0 -0.27"/>
          </body>
        </body>
      </body>
      <body name="fore_thigh" pos="0.5 0 0">
        <joint name="fore_thigh" class="driven" range="-1 0.7" stiffness="180" damping="4.5"/>
        <geom name="fore_thigh" size="0.046 0.133" pos="-0.07 0 -0.12" axisangle="0 1 0 0.52"/>
        <body name="fore_shin" pos="-0.14 0 -0.24">
          <joint name="fore_shin" class="driven" range="-1.2 0.87" stiffness="120" damping="3"/>
          <geom name="fore_shin" size="0.046 0.106" pos="0.065 0 -0.09" axisangle="0 1 0 -0.6"/>
          <body name="fore_foot" pos="0.13 0 -0.18">
            <joint name="fore_foot" class="driven" range="-0.5 0.5" stiffness="60" damping="1.5"/>
            <geom name="fore_foot" size="0.046 0.07" pos="0.045 0 -0.07" axisangle="0 1 0 -0.6"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="hind_thigh" joint="hind_thigh" gear="120"/><motor name="hind_shin" joint="hind_shin" gear="90"/>
    <motor name="hind_foot" joint="hind_foot" gear="60"/><motor name="fore_thigh" joint="fore_thigh" gear="120"/>
    <motor name="fore_shin" joint="fore_shin" gear="60"/><motor name="fore_foot" joint="fore_foot" gear="30"/>
  </actuator>
</mujoco>
"""

_CONTACTS: dict[str, HardContacts | SpringContacts] = {
    "matched": SpringContacts(stiffness=2e4, damping=1e3, friction_damping=1e3, friction=1.0),
    "published": HardContacts((0.02, 1.0), (0.0, 0.8, 0.01, 0.5, 2.0), friction=0.4),
}
_PUBLISHED_MASS = 14.0
"""Of the whole body [kg]."""
_RANGES = {"fore_thigh": (-1.5, 0.8), "fore_shin": (-1.2, 1.1), "fore_foot": (-3.1, -0.3)}
_TORQUE = 200.0


def build_cheetah(env: CheetahSettings, physics: PhysicsConfig) -> mujoco.MjModel:
    """Two slides and a hinge of the root, six driven hinges, six motors; positions are from the reference."""
    spec = mujoco.MjSpec.from_string(_MJCF)
    contacts = _CONTACTS[physics.variant or "matched"]
    if isinstance(contacts, SpringContacts):
        for joint in spec.joints:
            joint.armature = 0.1
            joint.damping[0] += contacts.limit_damping
            joint.range = _RANGES.get(joint.name, joint.range)
        for motor in spec.actuators:
            motor.gear[0] = _TORQUE
    else:
        scale = _PUBLISHED_MASS / spec.compile().body_mass.sum()
        for geom in spec.geoms:
            geom.density *= scale
    return compile_on_floor(spec, env, physics, contacts)
