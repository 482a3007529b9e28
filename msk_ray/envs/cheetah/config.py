"""The settings of the cheetah."""

from msk_ray.config.physics import CONTACTS, SOLVING, STEPPING
from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.sections import Count
from msk_ray.config.terms import Cost, Term, terms_in
from msk_ray.envs.limited_settings import EFFORT, JOINT_LIMIT, LimitedSettings

TERMS = terms_in(
    "msk_ray.envs.cheetah.env",
    Term("forward_vel", 1.0),
    Cost("action", 0.1, EFFORT, setting="action_penalty"),
    JOINT_LIMIT,
)
CheetahReward = reward_section("CheetahReward", __name__, TERMS)


@with_reward(CheetahReward)
class CheetahSettings(LimitedSettings):
    """A planar body on two legs whose reward asks for forward velocity. Its episodes end only at the time limit."""

    variants = ("matched", "published")
    pyramidal_variants = frozenset(("published",))
    reads_physics = STEPPING | SOLVING | CONTACTS | {"variant"}

    episode_length: Count = 1000
