"""The settings of the cheetah."""

from msk_ray.config.physics import CONTACTS, JOINTS, LIMITS, SOLVING, STEPPING
from msk_ray.config.sections import Count, LimitedReward, LimitedSettings, NonNegative


class CheetahReward(LimitedReward):
    """Weights per env step."""

    forward_vel: float = 1.0
    """Weight of the torso's velocity along +x [s/m]."""
    action_penalty: NonNegative = 0.1
    """Weight of the summed squared action."""


class CheetahSettings(LimitedSettings):
    """A planar body on two legs whose reward asks for forward velocity; its episodes end only at the time limit."""

    variants = ("matched", "published")
    pyramidal_variants = frozenset(("published",))
    reads_physics = STEPPING | SOLVING | CONTACTS | LIMITS | JOINTS | {"variant", "gear"}

    episode_length: Count = 1000
    reward: CheetahReward = CheetahReward()
