"""A pole on a cart on a rail, built with MjSpec."""

import mujoco

from msk_ray.config import PhysicsConfig
from msk_ray.envs.cartpole.config import CartPoleSettings
from msk_ray.envs.options import add_sky, apply_options

CART_MASS = 1.0
POLE_MASS = 0.25
POLE_LENGTH = 1.0
GEAR = 20.0


def build_cartpole(env: CartPoleSettings, physics: PhysicsConfig) -> mujoco.MjModel:
    """Cart of 1 kg, pole of 0.25 kg and 1 m, force of ±20 N at full control, no contacts.

    qpos is (cart position [m], pole angle [rad], 0 upright); qvel their rates; ctrl in [-1, 1].
    """
    spec = mujoco.MjSpec()
    spec.modelname = "cartpole"
    spec.compiler.degree = False
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    apply_options(spec, physics, env.control_timestep)
    add_sky(spec)
    world = spec.worldbody
    world.add_light(pos=[0, -2, 4], dir=[0, 0.4, -1])
    for metre in range(-4, 5):
        # Marks along the rail: the camera follows the cart, and they show that it moves.
        mark = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "contype": 0, "conaffinity": 0, "rgba": [0.3, 0.3, 0.3, 1]}
        world.add_geom(name=f"mark_{metre}", pos=[metre, 0.12, 0], size=[0.05, 0, 0], **mark)
    world.add_geom(
        name="rail",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[-4, 0.12, 0, 4, 0.12, 0],
        size=[0.02, 0, 0],
        rgba=[0.5, 0.5, 0.5, 1],
    )
    cart = world.add_body(name="cart")
    cart.add_joint(
        name="slider",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[1, 0, 0],
    )
    cart.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.15, 0.08, 0.06], mass=CART_MASS, rgba=[0.2, 0.35, 0.6, 1])
    cart.add_camera(
        name="side", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK, pos=[0, -4.5, 0.3], xyaxes=[1, 0, 0, 0, 0.0, 1]
    )
    pole = cart.add_body(name="pole")
    pole.add_joint(name="hinge", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    pole.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0, 0, 0, 0, 0, POLE_LENGTH],
        size=[0.03, 0, 0],
        mass=POLE_MASS,
        rgba=[0.85, 0.5, 0.2, 1],
    )
    motor = spec.add_actuator(name="force", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="slider")
    motor.gear[0] = GEAR
    motor.ctrllimited = True
    motor.ctrlrange = [-1.0, 1.0]
    return spec.compile()
