"""The settings of the ant."""

from msk_ray.config.physics import CONTACTS, JOINTS, LIMITS, SOLVING, STEPPING
from msk_ray.config.sections import Count, LimitedReward, LimitedSettings, NonNegative


class AntReward(LimitedReward):
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


class AntSettings(LimitedSettings):
    """A four-legged walker whose reward asks for forward velocity."""

    variants = ("matched", "matched_hard_friction", "matched_springs", "published")
    pyramidal_variants = frozenset(("published",))
    reads_physics = STEPPING | SOLVING | CONTACTS | LIMITS | JOINTS | {"variant", "gear"}

    episode_length: Count = 1000
    reward: AntReward = AntReward()
    termination_height: float = 0.27
    """Torso height below which an episode ends [m]."""
    early_termination: bool = True
    """End an episode on falling below `termination_height`."""
