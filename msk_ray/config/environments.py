"""The settings of CartPole and the ant."""

from typing import Literal

from msk_ray.config.physics import CONTACTS, JOINTS, LIMITS, SOLVING, STEPPING
from msk_ray.config.sections import Count, EnvSettings, NonNegative, Reward


class CartPoleReward(Reward):
    """Penalties per env step."""

    pole_angle_penalty: NonNegative = 1.0
    """Weight of angle² [1/rad²], with the angle wrapped to ±π."""
    pole_velocity_penalty: NonNegative = 0.1
    """Weight of angular velocity² [s²/rad²]."""
    cart_position_penalty: NonNegative = 0.05
    """Weight of position² [1/m²]."""
    cart_velocity_penalty: NonNegative = 0.1
    """Weight of velocity² [s²/m²]."""
    cart_action_penalty: NonNegative = 0.0
    """Weight of action²."""


class CartPoleEnvConfig(EnvSettings):
    """Swing up a pole on a cart and keep it there. Angle 0 is upright."""

    reads_physics = STEPPING | JOINTS | {"gear"}

    name: Literal["cartpole"]
    episode_length: Count = 240
    reward: CartPoleReward = CartPoleReward()


class AntReward(Reward):
    """Weights per env step."""

    forward_vel: float = 1.0
    """Weight of the torso's velocity along +x [s/m]."""
    heading: float = 1.0
    """Weight of the cosine between the torso's forward axis and +x."""
    up: float = 0.1
    """Weight of the cosine between the torso's up axis and +z."""
    height: float = 1.0
    """Weight of the torso's height above `env.termination_height` [1/m]."""
    action_penalty: NonNegative = 0.0
    """Weight of the summed squared action."""


class AntEnvConfig(EnvSettings):
    """A four-legged walker whose reward asks for forward velocity."""

    variants = ("matched", "matched_hard_friction", "published")
    pyramidal_variants = frozenset(("published",))
    reads_physics = STEPPING | SOLVING | CONTACTS | LIMITS | JOINTS | {"variant", "gear"}

    name: Literal["ant"]
    episode_length: Count = 1000
    reward: AntReward = AntReward()
    termination_height: float = 0.27
    """Torso height below which an episode ends [m]."""
    early_termination: bool = True
    """End an episode on falling below `termination_height`."""
