"""The settings of the humanoid."""

from msk_ray.config.physics import CONTACTS, JOINTS, LIMITS, SOLVING, STEPPING
from msk_ray.config.sections import Count, LimitedReward, LimitedSettings, NonNegative


class HumanoidReward(LimitedReward):
    """Weights per env step."""

    forward_vel: float = 1.0
    """Weight of the torso's velocity along +x [s/m]."""
    up: float = 0.1
    """Weight of the cosine between the torso's up axis and +z."""
    heading: float = 1.0
    """Weight of the cosine between the torso's forward axis and the way to a point 200 m ahead of the start."""
    height: float = 10.0
    """Weight of the torso's height above `full_height`, up to 0.1 m [1/m]."""
    drop: NonNegative = 200.0
    """Weight of (depth below `full_height`)², up to 1 m [1/m²]."""
    full_height: float = 0.84
    """Height of the torso that costs and earns nothing [m]."""
    action_penalty: NonNegative = 0.002
    """Weight of the summed squared action."""


class HumanoidSettings(LimitedSettings):
    """A walker on two legs whose reward asks for forward velocity."""

    variants = ("matched", "published")
    pyramidal_variants = frozenset(("published",))
    reads_physics = STEPPING | SOLVING | CONTACTS | LIMITS | JOINTS | {"variant"}

    episode_length: Count = 1000
    reward: HumanoidReward = HumanoidReward()
    termination_height: float = 0.74
    """Torso height below which an episode ends [m]."""
    early_termination: bool = True
    """End an episode on falling below `termination_height`."""

    def unread(self) -> dict[str, str]:
        heights = {} if self.early_termination else {"termination_height": "env.early_termination is false"}
        return super().unread() | heights
