"""The settings of CartPole."""

from msk_ray.config.physics import JOINTS, STEPPING
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


class CartPoleSettings(EnvSettings):
    """Swing up a pole on a cart and keep it there. Angle 0 is upright."""

    reads_physics = STEPPING | JOINTS | {"gear"}

    episode_length: Count = 240
    reward: CartPoleReward = CartPoleReward()
