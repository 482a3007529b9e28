"""The settings of CartPole."""

from msk_ray.config.physics import STEPPING
from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.sections import Count, EnvSettings
from msk_ray.config.terms import Cost, terms_in

TERMS = terms_in(
    "msk_ray.envs.cartpole.env",
    Cost("pole_angle", 1.0, setting="pole_angle_penalty"),
    Cost("pole_velocity", 0.1, setting="pole_velocity_penalty"),
    Cost("cart_position", 0.05, setting="cart_position_penalty"),
    Cost("cart_velocity", 0.1, setting="cart_velocity_penalty"),
    Cost("action", 0.0, "effort", setting="cart_action_penalty"),
)
CartPoleReward = reward_section("CartPoleReward", __name__, TERMS)


@with_reward(CartPoleReward)
class CartPoleSettings(EnvSettings):
    """Swing up a pole on a cart and keep it there. Angle 0 is upright."""

    reads_physics = STEPPING

    episode_length: Count = 240
