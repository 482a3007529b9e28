"""The settings of the humanoid."""

from msk_ray.config.physics import CONTACTS, SOLVING, STEPPING
from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.sections import Count, Reward
from msk_ray.config.terms import Cost, Term, terms_in
from msk_ray.envs.limited_settings import EFFORT, JOINT_LIMIT, FallingSettings


class HumanoidHeight(Reward):
    """The weight of the term `height` above the full height; below it, the weight is DiffRL's."""

    height: float = 10.0
    """Weight of the torso's height above 0.84 m, up to 0.1 m [1/m]; (depth below)², up to 1 m, costs 200 /m²."""


TERMS = terms_in(
    "msk_ray.envs.humanoid.env",
    Term("forward_vel", 1.0, "msk_ray.envs.floating:forward_vel"),
    Term("up", 0.1),
    Term("heading", 1.0),
    Term("height", None),
    Cost("action", 0.002, EFFORT, setting="action_penalty"),
    JOINT_LIMIT,
)
HumanoidReward = reward_section("HumanoidReward", __name__, TERMS, HumanoidHeight)


@with_reward(HumanoidReward)
class HumanoidSettings(FallingSettings):
    """A walker on two legs whose reward asks for forward velocity."""

    variants = ("matched", "published")
    pyramidal_variants = frozenset(("published",))
    reads_physics = STEPPING | SOLVING | CONTACTS | {"variant"}

    episode_length: Count = 1000
    reward: HumanoidHeight = HumanoidHeight()
    termination_height: float = 0.74
