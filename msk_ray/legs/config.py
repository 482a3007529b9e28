"""The settings shared by muscle-driven legs."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import Field, PositiveFloat, model_validator

from msk_ray.config.sections import Count, EnvSettings, Fraction, NonNegative, Reward, Section, Whole

FURTHER = (
    *("metabolic", "fatigue", "head", "impact", "footfall", "clearance", "toes", "vault", "out_of_plane", "track"),
    *("track_rate", "landing"),
)
"""Weights of terms that are there only where they are not zero."""
OUT_OF_PLANE = ("hip_adduction", "hip_rotation", "subtalar_angle")
"""Joints, without their side, whose angles the term `out_of_plane` keeps small."""
CLOCKED = ("footfall", "landing", "clearance", "toes", "vault", "track", "track_rate")
"""Weights of terms that need the clock."""


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
    metabolic: NonNegative = 0.0
    """Weight of the metabolic power of all muscles per kg of body mass, without that of rest [kg/W]; walking people
    have about 3 W/kg. The model is that of Bhargava et al. 2004 (`msk_ray/legs/metabolic.py`)."""
    fatigue: NonNegative = 0.0
    """Weight of the mean cubed activation."""
    head: NonNegative = 0.0
    """Weight of the squared speed of the head up and to the side [s²/m²]; it moves with pelvis and trunk, 0.65 m above
    the pelvis."""
    impact: NonNegative = 0.0
    """Weight of the squared downward speed of heels and toes close to the ground [s²/m²]. (Contact forces carry no
    gradient.)"""
    footfall: NonNegative = 0.0
    """Weight of the speed of heel and toes while the clock wants them on the ground: in people the heel is down until
    40 % of the cycle, the toes from 10 to 60 %. Needs `env.clock`."""
    landing: NonNegative = 0.0
    """Weight of √(1 + (h / 2 mm)²) - 1, where h is how far a heel is above its place in standing, from 4 % of the cycle
    before the clock wants it to strike to 12 % after. Without it a heel may hover a few millimetres above the ground,
    slowly enough for `footfall`, and land late. Needs `env.clock`."""
    clearance: NonNegative = 0.0
    """Weight of ((clearance_height - height) / clearance_height)² of heel and toes below that height while the clock
    wants the foot in the air. Needs `env.clock`."""
    clearance_height: PositiveFloat = 0.01
    """Height above their place in standing that feet should have in swing [m]; people's toes clear the ground by 1 to 2
    cm."""
    toes: NonNegative = 0.0
    """Weight of the angle of the toes from level while the clock wants them on the ground, and from straight otherwise,
    linear beyond 0.15 rad. Without it they stay lifted, and the foot has no lever for the end of the push-off. Needs
    `env.clock`."""
    vault: NonNegative = 0.0
    """Weight of √(1 + (Δv / 0.1 m/s)²) - 1, where Δv is how far the pelvis's vertical velocity is from that of a body
    that vaults over each leg: lowest in the middle of double support, highest half a step later, by as much as people's
    centre of mass rises at that speed. It decides when feet push off. Needs `env.clock`."""
    out_of_plane: NonNegative = 0.0
    """Weight of √(1 + mean (q / 0.15 rad)²) - 1 of hip adduction, hip rotation and subtalar angle q, as far as the
    model has them: joints that turn people's legs out of the plane they walk in, by less than 10° either way."""
    track: NonNegative = 0.0
    """Weight of √(1 + mean (Δq / track_scale)²) - 1, where Δq is how far hip flexion, knee and ankle of both legs are
    from the mean of people at the clock's phase. Needs `env.clock`."""
    track_scale: PositiveFloat = 0.15
    """Distance from the reference beyond which the term above grows linearly [rad]."""
    track_rate: NonNegative = 0.0
    """The same for their rates. Needs `env.clock`."""
    track_rate_scale: PositiveFloat = 2.0
    """Scale of the term above [rad/s]."""


class TrackingSchedule(Section):
    """Factor on the weights `track` and `track_rate`: `start` at epoch 0, `end` from epoch `epochs` on."""

    start: NonNegative = 1.0
    end: NonNegative = 1.0
    epochs: Whole = 0
    """Epochs of the change, which is linear; 0: `end` from the beginning."""

    def at(self, epoch: int) -> float:
        """The factor at `epoch`, counted from 0."""
        return self.end if epoch >= self.epochs else self.start + (self.end - self.start) * epoch / self.epochs


class AssistConfig(Section):
    """Springs and dampers that hold the pelvis up during training, annealed to zero.

    Evaluation never uses them.
    """

    epochs: Whole = 0
    """Epochs until they are gone; 0: none at all."""
    share: Fraction = 1.0
    """Share of the stiffness below, at epoch 0."""
    power: PositiveFloat = 1.0
    """The share falls as (1 - epoch / epochs)^power: above 1, more epochs have weak springs, which leave the balance to
    the policy."""
    steady: PositiveFloat | None = None
    """Training time from the end of one episode to the next [s] from which an epoch counts as one of `epochs`: the
    springs stay as strong as they are while the legs fall sooner. Null: every epoch counts."""
    balance: NonNegative = 800.0
    """Righting torque of tilt and list [N m/rad]; that of rotation is smaller in proportion to its inertia. Critically
    damped."""
    lateral: NonNegative = 800.0
    """Force towards the walking line [N/m]. Critically damped."""
    support: Fraction = 0.0
    """Share of the body's weight that is carried."""

    def at(self, epoch: int) -> float:
        """Share of the stiffness after `epoch` epochs that count."""
        return self.share * max(0.0, 1.0 - epoch / self.epochs) ** self.power if self.epochs else 0.0

    def unread(self) -> dict[str, str]:
        """Settings that nothing reads, with the reason."""
        names = () if self.epochs else ("share", "power", "steady", "balance", "lateral", "support")
        return {f"assist.{name}": "env.assist.epochs is 0" for name in names}


class PushConfig(Section):
    """Pushes of the pelvis, which change its speed at once."""

    speed: NonNegative = 0.0
    """Change of the pelvis's horizontal velocity [m/s]; 0: no pushes."""
    interval: PositiveFloat = 2.0
    """Time between pushes [s]; their directions go around by 137.5° from one to the next and from world to world."""


class LegSettings(EnvSettings):
    """The settings shared by muscle-driven legs."""

    conditions: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "push": {"env.push": {"speed": 0.3}},
        "weak": {"physics.randomize": {"actuator_gain": {"low": 0.5, "high": 0.5}}},
    }

    episode_length: Count = 500
    control_timestep: PositiveFloat = 0.02
    target_speed: NonNegative = 1.25
    """Target forward speed [m/s]; 0 means standing."""
    speed_range: tuple[PositiveFloat, PositiveFloat] | None = None
    """Smallest and largest target speed [m/s]: every episode of training draws one, scores are at `target_speed`; null:
    that one always."""
    clock: bool = False
    """Observe cos and sin of the phase of the right leg's gait cycle. It turns at the cadence of people at the target
    speed; the left leg is half a turn behind."""
    symmetric: bool = False
    """One half of the cycle is the mirror image of the other: while the clock is in its second half, the policy
    observes the legs with right and left exchanged, and so are its actions. Needs `env.clock`."""
    gait_worlds: Whole = 0
    """Worlds of every evaluation during training whose gait is compared with people's (`eval/gait_distance`, `cadence`,
    `step_length`, `duty_factor`, `asymmetry`, `cost_of_transport`), by C MuJoCo: about 0.02 s each; 0: none. They are
    measured at control steps, so that foot strikes are seen up to one of them late; `msk_ray.legs.gait` measures at
    substeps."""
    assist: AssistConfig = AssistConfig()
    push: PushConfig = PushConfig()
    tracking: TrackingSchedule = TrackingSchedule()
    """Schedule of the terms that track people's motion."""
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

    @model_validator(mode="after")
    def _clock_and_speeds(self) -> "LegSettings":
        weighed = [f"env.reward.{name}" for name in CLOCKED if getattr(self.reward, name) > 0.0]
        if not self.clock and (weighed or self.symmetric):
            raise ValueError(f"{(weighed or ['env.symmetric'])[0]} needs the phase of the walk: write env.clock: true")
        if self.clock and self.target_speed == 0.0:
            raise ValueError("env.clock is that of a walk: write an env.target_speed above 0")
        if self.speed_range is not None:
            if self.speed_range[0] > self.speed_range[1]:
                raise ValueError("env.speed_range: write the smaller speed first")
            if self.target_speed == 0.0:
                raise ValueError("env.speed_range is for walking: write an env.target_speed above 0")
        return self

    def unread(self) -> dict[str, str]:
        unread = self.assist.unread()
        r = self.reward
        if self.push.speed == 0.0:
            unread["push.interval"] = "env.push.speed is 0"
        for name, weight in (
            ("clearance_height", "clearance"),
            ("track_scale", "track"),
            ("track_rate_scale", "track_rate"),
        ):
            if getattr(r, weight) == 0.0:
                unread[f"reward.{name}"] = f"env.reward.{weight} is 0"
        if r.track == r.track_rate == 0.0:
            for name in ("start", "end", "epochs"):
                unread[f"tracking.{name}"] = "env.reward.track and track_rate are 0"
        elif not self.tracking.epochs:
            unread["tracking.start"] = "env.tracking.epochs is 0"
        if self.clock and r.stride > 0.0:
            for name in ("stride_angle", "cadence"):
                unread[f"reward.{name}"] = "env.clock gives people's cadence and step length"
        if not self.early_termination:
            unread["min_height"] = "env.early_termination is false"
        if self.target_speed == 0.0:
            unread["success_speed"] = "env.target_speed 0 asks to stand"
        return unread
