"""Models small enough that their derivatives can be worked out by hand, and an ant-like one that touches ground."""

import mujoco

CARTPOLE = """
<mujoco model="cartpole">
  <option timestep="0.0041666667"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom type="box" size=".2 .1 .1" mass="1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size=".05" mass=".1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slide" gear="20" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>"""

_LEG = """
<body pos="{hip}">
  <joint name="hip{i}" axis="0 0 1" range="-40 40"/>
  <geom type="capsule" fromto="0 0 0 {hip}"/>
  <body pos="{hip}">
    <joint name="ankle{i}" axis="{axis}" range="30 100"/>
    <geom type="capsule" fromto="0 0 0 {foot}"/>
  </body>
</body>"""


def ant_xml(cone: str) -> str:
    """Free torso and four legs of two hinges, soft ground contact, heavy joint damping."""
    corners = [(1, 1), (-1, 1), (-1, -1), (1, -1)]
    legs = "".join(
        _LEG.format(i=i, hip=f"{0.2 * x} {0.2 * y} 0", foot=f"{0.4 * x} {0.4 * y} 0", axis=f"{-y} {x} 0")
        for i, (x, y) in enumerate(corners)
    )
    motors = "".join(f'<motor joint="{joint}{i}"/>' for i in range(4) for joint in ("hip", "ankle"))
    return f"""
<mujoco model="ant_like">
  <compiler angle="degree"/>
  <option timestep="0.0041666667" cone="{cone}"/>
  <default>
    <joint damping="11" armature=".05" limited="true" solreflimit="-122 -1.2" solimplimit="0.9 0.9 0.01 0.5 2"/>
    <geom size=".08" density="1000" friction=".75 .1 .1" solref=".065 1" solimp="0.9 0.9 0.01 0.5 2"
          contype="0" conaffinity="1"/>
    <motor gear="200" ctrllimited="true" ctrlrange="-1 1"/>
  </default>
  <worldbody>
    <geom type="plane" size="50 50 1" contype="1" conaffinity="0"/>
    <body pos="0 0 .75"><freejoint/><geom type="sphere" size=".25"/>{legs}</body>
  </worldbody>
  <actuator>{motors}</actuator>
  <keyframe><key qpos="0 0 .75  1 0 0 0  0 1 0 1 0 1 0 1"/></keyframe>
</mujoco>"""


SLIDE = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody><body>
    <joint name="x" type="slide" axis="1 0 0" damping="{damping}"/>
    <geom type="sphere" size=".1" mass="2"/>
  </body></worldbody>
  <actuator>{actuator}</actuator>
</mujoco>"""
MOTOR = '<motor joint="x" gear="3" ctrllimited="true" ctrlrange="-1 1"/>'
FILTERED = '<general joint="x" dyntype="filter" dynprm="0.05" gainprm="3"/>'


def slide_model(damping: float = 0.0, actuator: str = MOTOR) -> mujoco.MjModel:
    """A mass of 2 kg on a rail, step 0.01 s, no gravity, actuator gain 3."""
    return mujoco.MjModel.from_xml_string(SLIDE.format(damping=damping, actuator=actuator))


def ball_on_plane() -> mujoco.MjModel:
    """A free sphere of radius 0.1 above a plane."""
    return mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 .1"><freejoint/><geom type="sphere" size=".1" mass="1"/></body>
  </worldbody>
</mujoco>""")
