"""The settings of the ant."""

from msk_ray.config.physics import CONTACTS, SOLVING, STEPPING
from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.sections import Count
from msk_ray.config.terms import Cost, Term, terms_in
from msk_ray.envs.limited_settings import EFFORT, JOINT_LIMIT, LimitedSettings

TERMS = terms_in(
    "msk_ray.envs.ant.env",
    Term("forward_vel", 1.0),
    Term("up", 0.1),
    Term("heading", 1.0),
    Term("height", 1.0),
    Cost("action", 0.0, EFFORT, setting="action_penalty"),
    JOINT_LIMIT,
)
AntReward = reward_section("AntReward", __name__, TERMS)


@with_reward(AntReward)
class AntSettings(LimitedSettings):
    """A four-legged walker whose reward asks for forward velocity."""

    variants = ("matched", "matched_hard_friction", "matched_springs", "published")
    pyramidal_variants = frozenset(("published",))
    reads_physics = STEPPING | SOLVING | CONTACTS | {"variant"}

    episode_length: Count = 1000
    termination_height: float = 0.27
    """Torso height below which an episode ends [m]."""
    early_termination: bool = True
    """End an episode on falling below `termination_height`."""
