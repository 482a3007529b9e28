"""The settings of the hopper."""

from msk_ray.config.physics import CONTACTS, JOINTS, LIMITS, SOLVING, STEPPING
from msk_ray.config.sections import Count, LimitedReward, LimitedSettings, NonNegative


class HopperReward(LimitedReward):
    """Weights per env step."""

    forward_vel: float = 1.0
    """Weight of the torso's velocity along +x [s/m]."""
    height: float = 1.0
    """Weight of the torso's height above `full_height`, up to 0.3 m [1/m]."""
    drop: NonNegative = 200.0
    """Weight of (depth below `full_height`)², up to 1 m [1/m²]."""
    full_height: float = -0.3
    """Height of the torso, from 1.25 m, that costs and earns nothing [m]."""
    upright: float = 1.0
    """Weight of 1 − (pitch / 30°)²."""
    action_penalty: NonNegative = 0.1
    """Weight of the summed squared action."""


class HopperSettings(LimitedSettings):
    """A planar body on one leg whose reward asks for forward velocity."""

    variants = ("matched", "published")
    pyramidal_variants = frozenset(("published",))
    reads_physics = STEPPING | SOLVING | CONTACTS | LIMITS | JOINTS | {"variant", "gear"}

    episode_length: Count = 1000
    reward: HopperReward = HopperReward()
    termination_height: float = -0.45
    """Height of the torso, from 1.25 m, below which an episode ends [m]."""
    early_termination: bool = True
    """End an episode on falling below `termination_height`."""

    def unread(self) -> dict[str, str]:
        heights = {} if self.early_termination else {"termination_height": "env.early_termination is false"}
        return super().unread() | heights
