"""The hopper: torso, thigh, leg and foot in a vertical plane, in two named physics.

Measures, masses, springs and motors are those of the classic hopper (Gymnasium's `hopper.xml` for `published`), and of
DiffRL's, `envs/hopper.py` and `envs/assets/hopper.xml` of github.com/NVlabs/DiffRL, for `matched`. dflex gives the two
slides and the hinge of the root the armature of 1 and the damper of 10 that all other joints have.
"""

import mujoco

from msk_ray.config import PhysicsConfig
from msk_ray.envs.floor import HardContacts, SpringContacts, compile_on_floor
from msk_ray.envs.hopper.config import HopperSettings

TORSO_HEIGHT = 1.25
"""Height of the torso's centre in the reference configuration [m]; the foot is 4 cm above the floor then."""

_MJCF = f"""
<mujoco model="hopper">
  <compiler angle="radian"/>
  <default>
    <geom type="capsule" contype="0" conaffinity="0" density="1000" rgba="0.8 0.6 0.3 1"/>
    <default class="driven"><joint type="hinge" axis="0 -1 0" limited="true" armature="1" damping="1"/></default>
    <motor gear="200" ctrllimited="true" ctrlrange="-1 1"/>
  </default>
  <worldbody>
    <body name="torso" pos="0 0 {TORSO_HEIGHT}">
      <camera name="track" mode="trackcom" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/>
      <light mode="trackcom" pos="0 0 4" dir="0 0 -1" type="directional"/>
      <joint name="root_x" type="slide" axis="1 0 0"/>
      <joint name="root_z" type="slide" axis="0 0 1"/>
      <joint name="root_pitch" type="hinge" axis="0 1 0"/>
      <geom name="torso" size="0.05" fromto="0 0 -0.2 0 0 0.2"/>
      <body name="thigh" pos="0 0 -0.2">
        <joint name="thigh" class="driven" range="-2.61799 0"/>
        <geom name="thigh" size="0.05" fromto="0 0 -0.45 0 0 0"/>
        <body name="leg" pos="0 0 -0.45">
          <joint name="leg" class="driven" range="-2.61799 0"/>
          <geom name="leg" size="0.04" fromto="0 0 -0.5 0 0 0"/>
          <body name="foot" pos="0 0 -0.5">
            <joint name="foot" class="driven" range="-0.785398 0.785398"/>
            <geom name="foot" size="0.06" fromto="-0.135 0 0 0.255 0 0"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="thigh" joint="thigh"/><motor name="leg" joint="leg"/><motor name="foot" joint="foot"/>
  </actuator>
</mujoco>
"""

_CONTACTS: dict[str, HardContacts | SpringContacts] = {
    "matched": SpringContacts(stiffness=2e4, damping=1e3, friction_damping=1e3, friction=0.9),
    "published": HardContacts(
        (0.02, 1.0), (0.8, 0.8, 0.01, 0.5, 2.0), friction=1.0, frictions={"foot": 2.0}, margin=0.001
    ),
}
_DAMPING = 2.0


def build_hopper(env: HopperSettings, physics: PhysicsConfig) -> mujoco.MjModel:
    """Two slides and a hinge of the root, three driven hinges, three motors; positions are from the reference."""
    spec = mujoco.MjSpec.from_string(_MJCF)
    contacts = _CONTACTS[physics.variant or "matched"]
    if isinstance(contacts, SpringContacts):
        for joint in spec.joints:
            joint.armature = 1.0
            joint.damping[0] = contacts.limit_damping + (0.0 if joint.name.startswith("root") else _DAMPING)
    return compile_on_floor(spec, env, physics, contacts)
