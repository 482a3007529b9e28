"""The settings of the ant."""

from msk_ray.config.physics import CONTACTS, SOLVING, STEPPING
from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.sections import Count
from msk_ray.config.terms import Cost, Term, terms_in
from msk_ray.envs.limited_settings import EFFORT, JOINT_LIMIT, FallingSettings

TERMS = terms_in(
    "msk_ray.envs.ant.env",
    Term("forward_vel", 1.0, "msk_ray.envs.floating:forward_vel"),
    Term("up", 0.1),
    Term("heading", 1.0),
    Term("height", 1.0),
    Cost("action", 0.0, EFFORT, setting="action_penalty"),
    JOINT_LIMIT,
)
AntReward = reward_section("AntReward", __name__, TERMS)


@with_reward(AntReward)
class AntSettings(FallingSettings):
    """A four-legged walker whose reward asks for forward velocity."""

    variants = ("matched", "matched_hard_friction", "matched_springs", "published")
    pyramidal_variants = frozenset(("published",))
    reads_physics = STEPPING | SOLVING | CONTACTS | {"variant"}

    episode_length: Count = 1000
    termination_height: float = 0.27

    def unread(self) -> dict[str, str]:
        return {}  # the term `height` reads the height below which an episode would end
