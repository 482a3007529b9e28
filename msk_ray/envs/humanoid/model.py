"""The humanoid: 13 bodies, 21 driven hinges and a free root, in two named physics.

The body is that of DiffRL's `envs/assets/humanoid.xml` (github.com/NVlabs/DiffRL), without the pelvis's and waist's
rotations of 0.2°, which dflex does not read. `published` is what MuJoCo makes of that file, with its motors; contacts
are with the floor only. `matched` is what dflex makes of it with the parameters and torques of `envs/humanoid.py`.
"""

import mujoco

from msk_ray.config import PhysicsConfig
from msk_ray.envs.floor import HardContacts, SpringContacts, compile_on_floor
from msk_ray.envs.humanoid.config import HumanoidSettings

START_HEIGHT = 1.35
"""Height of the torso in the reference configuration, in which episodes start [m]."""

_BODY = """
<mujoco model="humanoid">
  <compiler angle="degree"/>
  <default>
    <geom type="capsule" contype="0" conaffinity="0" density="1000" rgba="0.8 0.6 0.3 1"/>
    <default class="driven">
      <joint type="hinge" limited="true" stiffness="5" damping="0.1" armature="0.007" solimplimit="0 0.99 0.01"/>
      <default class="strong"><joint damping="5" armature="0.01"/></default>
      <default class="weak"><joint stiffness="2" damping="1" armature="0.006"/></default>
    </default>
    <motor ctrllimited="true" ctrlrange="-1 1"/>
  </default>
  <worldbody>
    <body name="torso" pos="0 0 1.35">
      <camera name="track" mode="trackcom" pos="0 -4 0.5" xyaxes="1 0 0 0 0 1"/>
      <light mode="trackcom" pos="0 0 6" dir="0 0 -1" type="directional"/>
      <freejoint name="root"/>
      <geom name="torso" size="0.07" fromto="0 -0.07 0 0 0.07 0"/>
      <geom name="upper_waist" size="0.06" fromto="-0.01 -0.06 -0.12 -0.01 0.06 -0.12"/>
      <geom name="head" type="sphere" size="0.09" pos="0 0 0.19"/>
      <body name="lower_waist" pos="-0.01 0 -0.26">
        <joint name="abdomen_z" class="strong" pos="0 0 0.065" axis="0 0 1" range="-45 45" stiffness="20"
          armature="0.02"/>
        <joint name="abdomen_y" class="strong" pos="0 0 0.065" axis="0 1 0" range="-75 30" stiffness="20"/>
        <geom name="lower_waist" size="0.06" fromto="0 -0.06 0 0 0.06 0"/>
        <body name="pelvis" pos="0 0 -0.165">
          <joint name="abdomen_x" class="strong" pos="0 0 0.1" axis="1 0 0" range="-35 35" stiffness="10"/>
          <geom name="butt" size="0.09" fromto="-0.02 -0.07 0 -0.02 0.07 0"/>
          <body name="right_thigh" pos="0 -0.1 -0.04">
            <joint name="right_hip_x" class="strong" axis="1 0 0" range="-25 5" stiffness="10"/>
            <joint name="right_hip_z" class="strong" axis="0 0 1" range="-60 35" stiffness="10"/>
            <joint name="right_hip_y" class="strong" axis="0 1 0" range="-80 20" stiffness="20"/>
            <geom name="right_thigh" size="0.06" fromto="0 0 0 0 0.01 -0.34"/>
            <body name="right_shin" pos="0 0.01 -0.403">
              <joint name="right_knee" class="driven" pos="0 0 0.02" axis="0 -1 0" range="-160 2"/>
              <geom name="right_shin" size="0.049" fromto="0 0 0 0 0 -0.3"/>
              <body name="right_foot" pos="0 0 -0.39">
                <joint name="right_ankle_y" class="weak" pos="0 0 0.08" axis="0 1 0" range="-50 50"/>
                <joint name="right_ankle_x" class="weak" pos="0 0 0.08" axis="1 0 0.5" range="-50 50"/>
                <geom name="right_foot_outer" size="0.027" fromto="-0.07 -0.02 0 0.14 -0.04 0"/>
                <geom name="right_foot_inner" size="0.027" fromto="-0.07 0 0 0.14 0.02 0"/>
              </body>
            </body>
          </body>
          <body name="left_thigh" pos="0 0.1 -0.04">
            <joint name="left_hip_x" class="strong" axis="-1 0 0" range="-25 5" stiffness="10"/>
            <joint name="left_hip_z" class="strong" axis="0 0 -1" range="-60 35" stiffness="10"/>
            <joint name="left_hip_y" class="strong" axis="0 1 0" range="-80 20" stiffness="20"/>
            <geom name="left_thigh" size="0.06" fromto="0 0 0 0 -0.01 -0.34"/>
            <body name="left_shin" pos="0 -0.01 -0.403">
              <joint name="left_knee" class="driven" pos="0 0 0.02" axis="0 -1 0" range="-160 2"/>
              <geom name="left_shin" size="0.049" fromto="0 0 0 0 0 -0.3"/>
              <body name="left_foot" pos="0 0 -0.39">
                <joint name="left_ankle_y" class="weak" pos="0 0 0.08" axis="0 1 0" range="-50 50"/>
                <joint name="left_ankle_x" class="weak" pos="0 0 0.08" axis="1 0 0.5" range="-50 50"/>
                <geom name="left_foot_outer" size="0.027" fromto="-0.07 0.02 0 0.14 0.04 0"/>
                <geom name="left_foot_inner" size="0.027" fromto="-0.07 0 0 0.14 -0.02 0"/>
              </body>
            </body>
          </body>
        </body>
      </body>
      <body name="right_upper_arm" pos="0 -0.17 0.06">
        <joint name="right_shoulder1" class="strong" axis="2 1 1" range="-60 60" stiffness="10"/>
        <joint name="right_shoulder2" class="strong" axis="0 -1 1" range="-60 60" stiffness="10"/>
        <geom name="right_upper_arm" size="0.04" fromto="0 0 0 0.16 -0.16 -0.16"/>
        <body name="right_lower_arm" pos="0.18 -0.18 -0.18">
          <joint name="right_elbow" class="weak" axis="0 -1 1" range="-90 50"/>
          <geom name="right_lower_arm" size="0.031" fromto="0.01 0.01 0.01 0.17 0.17 0.17"/>
          <geom name="right_hand" type="sphere" size="0.04" pos="0.18 0.18 0.18"/>
        </body>
      </body>
      <body name="left_upper_arm" pos="0 0.17 0.06">
        <joint name="left_shoulder1" class="strong" axis="-2 1 -1" range="-60 60" stiffness="10"/>
        <joint name="left_shoulder2" class="strong" axis="0 -1 -1" range="-60 60" stiffness="10"/>
        <geom name="left_upper_arm" size="0.04" fromto="0 0 0 0.16 0.16 -0.16"/>
        <body name="left_lower_arm" pos="0.18 0.18 -0.18">
          <joint name="left_elbow" class="weak" axis="0 -1 -1" range="-90 50"/>
          <geom name="left_lower_arm" size="0.031" fromto="0.01 -0.01 0.01 0.17 -0.17 0.17"/>
          <geom name="left_hand" type="sphere" size="0.04" pos="0.18 -0.18 0.18"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

_CONTACTS: dict[str, HardContacts | SpringContacts] = {
    "matched": SpringContacts(stiffness=2e4, damping=5e3, friction_damping=1e3, friction=0.75),
    # A mean of the floor's and the body's, as MuJoCo mixes them.
    "published": HardContacts((0.0175, 1.0), (0.9, 0.97, 0.002, 0.5, 2.0), friction=1.0),
}
_TORQUES = {
    "abdomen": (200.0, 67.5),
    "hip_x": (200.0, 45.0),
    "hip_z": (200.0, 45.0),
    "hip_y": (600.0, 135.0),
    "knee": (400.0, 90.0),
    "ankle": (100.0, 22.5),
    "shoulder": (100.0, 67.5),
    "elbow": (200.0, 45.0),
}
"""Strength of DiffRL's motors, of which 0.35 is used, and gear of those in the model's file [N m], by part of the
joint's name."""
_USED = 0.35


def build_humanoid(env: HumanoidSettings, physics: PhysicsConfig) -> mujoco.MjModel:
    """A free root, 21 driven hinges, and a motor for each in their order, which is that of DiffRL's actions."""
    spec = mujoco.MjSpec.from_string(_BODY)
    contacts = _CONTACTS[physics.variant or "matched"]
    for joint in spec.joints:
        if joint.type != mujoco.mjtJoint.mjJNT_HINGE:
            continue
        (strength, gear) = next(torques for part, torques in _TORQUES.items() if part in joint.name)
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.ctrllimited, motor.ctrlrange = True, [-1.0, 1.0]
        motor.gear[0] = _USED * strength if isinstance(contacts, SpringContacts) else gear
        if isinstance(contacts, SpringContacts):
            joint.damping[0] += contacts.limit_damping
    return compile_on_floor(spec, env, physics, contacts)
