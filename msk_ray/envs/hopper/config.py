"""The settings of the hopper."""

from msk_ray.config.physics import CONTACTS, SOLVING, STEPPING
from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.sections import Count, Reward
from msk_ray.config.terms import Cost, Term, terms_in
from msk_ray.envs.limited_settings import EFFORT, JOINT_LIMIT, FallingSettings


class HopperHeight(Reward):
    """The weight of the term `height` above the full height; below it, the weight is DiffRL's."""

    height: float = 1.0
    """Weight of the torso's height above 0.95 m, up to 0.3 m [1/m]; (depth below)², up to 1 m, costs 200 /m²."""


TERMS = terms_in(
    "msk_ray.envs.hopper.env",
    Term("forward_vel", 1.0),
    Term("height", None),
    Term("upright", 1.0),
    Cost("action", 0.1, EFFORT, setting="action_penalty"),
    JOINT_LIMIT,
)
HopperReward = reward_section("HopperReward", __name__, TERMS, HopperHeight)


@with_reward(HopperReward)
class HopperSettings(FallingSettings):
    """A planar body on one leg whose reward asks for forward velocity."""

    variants = ("matched", "published")
    pyramidal_variants = frozenset(("published",))
    reads_physics = STEPPING | SOLVING | CONTACTS | {"variant"}

    episode_length: Count = 1000
    reward: HopperHeight = HopperHeight()
    termination_height: float = -0.45
    """Height of the torso, from 1.25 m, below which an episode ends [m]."""
