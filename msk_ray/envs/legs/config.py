"""The settings shared by muscle-driven legs."""

from typing import Annotated

from pydantic import Field, PositiveFloat

from msk_ray.config.sections import Count, EnvSettings, NonNegative, Reward


class LegReward(Reward):
    """Weights per control step."""

    forward_vel: float = 1.0
    """Weight of exp(-((v - env.target_speed) / speed_scale)²)."""
    speed_scale: PositiveFloat = 0.6
    """Speed error at which the term above has fallen to 1/e [m/s]."""
    progress: float = 0.0
    """Weight of the forward speed, up to env.target_speed [s/m]: a slope where the term above is flat."""
    upright: float = 2.0
    """Weight of the cosine between the trunk's up axis and +z."""
    heading: float = 0.2
    """Weight of the cosine between the pelvis's forward axis and +x."""
    height: NonNegative = 5.0
    """Weight of (drop below the standing height)² [1/m²]."""
    alive: float = 0.5
    """Reward for every step without a fall."""
    effort: NonNegative = 0.2
    """Weight of the mean squared activation; zero at rest."""
    joint_limit: NonNegative = 0.1
    """Weight of the summed squared overshoot past the joint limits, minus a margin of 0.05 rad, in units of 0.1 rad."""
    smoothness: NonNegative = 0.02
    """Weight of the mean squared change of the action."""
    capture: NonNegative = 0.3
    """Weight of √(1 + (d / capture_scale)²) - 1, where d is the distance of the capture point from the walking line, or
    from the start when standing. The capture point is where the body would come to rest as a pendulum,
    x + v / √(g / height), with x and v of its centre of mass estimated from pelvis and lean of the trunk."""
    capture_scale: PositiveFloat = 0.1
    """Distance beyond which the term above grows linearly [m], so that the cost of a fall stays moderate."""
    sway: NonNegative = 0.02
    """Weight of the squared angular velocity of the pelvis [s²/rad²]."""
    symmetry: NonNegative = 0.0
    """Weight of the squared sum of both hips' flexion rates [s²/rad²]: legs in antiphase, without a reference gait."""
    stride: NonNegative = 0.0
    """Weight of (r - 1)² with r² = (d / stride_angle)² + (d' / (stride_angle ω))², where d is the angle between both
    hips' flexions, d' its rate and ω = 2π cadence / 120 s. The cost is zero if the legs swing against each other like a
    pendulum of that angle and cadence, in any phase; quick small steps are penalised at each turning point."""
    stride_angle: PositiveFloat = 0.75
    """Largest angle between the hips' flexions [rad]: 2 asin(step length / (2 leg length)) for 0.67 m and 0.9 m."""
    cadence: PositiveFloat = 112.0
    """Steps per minute, about as many as people take at 1.25 m/s [1/min]."""


class LegSettings(EnvSettings):
    """The settings shared by muscle-driven legs."""

    episode_length: Count = 500
    control_timestep: PositiveFloat = 0.02
    target_speed: NonNegative = 1.25
    """Target forward speed [m/s]; 0 means standing."""
    min_height: float = 0.65
    """Pelvis height above the ground, as a share of the standing height, below which an episode ends."""
    min_upright: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.5
    """Cosine between the trunk's up axis and +z below which an episode ends."""
    early_termination: bool = True
    """End an episode on a fall."""
    rest_excitation: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.02
    """Smallest excitation of a muscle at action 0, unless the standing keyframe has a larger one."""
    success_speed: NonNegative = 0.8
    """Mean speed over the episode from which walking counts as a success [m/s]."""
    reward: LegReward = LegReward()

    def unread(self) -> dict[str, str]:
        unread = {}
        if not self.early_termination:
            unread["min_height"] = "env.early_termination is false"
        if self.target_speed == 0.0:
            unread["success_speed"] = "env.target_speed 0 asks to stand"
        return unread
