"""The settings shared by muscle-driven legs."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import Field, PositiveFloat, model_validator

from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.sections import Count, EnvSettings, Fraction, NonNegative, Reward, Section, Whole
from msk_ray.config.terms import Cost, Term, terms_in

OUT_OF_PLANE = ("hip_adduction", "hip_rotation", "subtalar_angle")
"""Joints, without their side, whose angles the term `out_of_plane` keeps small."""


class LegShape(Reward):
    """The settings of terms other than their weights."""

    speed_scale: PositiveFloat = 0.6
    """Speed error at which the term `forward_vel` has fallen to 1/e [m/s]."""
    capture_scale: PositiveFloat = 0.1
    """Distance beyond which the term `capture` grows linearly [m], so that the cost of a fall stays moderate."""
    stride_angle: PositiveFloat = 0.75
    """Largest angle between the hips' flexions [rad]: 2 asin(step length / (2 leg length)) for 0.67 m and 0.9 m."""
    cadence: PositiveFloat = 112.0
    """Steps per minute, about as many as people take at 1.25 m/s [1/min]."""
    clearance_height: PositiveFloat = 0.01
    """Height above their place in standing that feet should have in swing [m]; people's toes clear the ground by 1 to 2
    cm."""
    track_scale: PositiveFloat = 0.15
    """Distance from the reference beyond which the term `track` grows linearly [rad]."""
    track_rate_scale: PositiveFloat = 2.0
    """The same of the term `track_rate` [rad/s]."""


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


def _tracking(settings: "LegSettings", epoch: int) -> float:
    return settings.tracking.at(epoch)


TERMS = terms_in(
    "msk_ray.legs.terms",
    Term("forward_vel", 1.0, needs=("reward.speed_scale",)),
    Term("progress", 0.0),
    Term("upright", 2.0),
    Term("heading", 0.2),
    Cost("height", 5.0),
    Term("alive", 0.5, gradient=False),
    Cost("effort", 0.2),
    Cost("joint_limit", 0.1),
    Cost("smoothness", 0.02),
    Cost("capture", 0.3, needs=("reward.capture_scale",)),
    Cost("sway", 0.02),
    Cost("symmetry", 0.0),
    Cost("stride", 0.0, needs=("reward.stride_angle", "reward.cadence")),
    Cost("metabolic", 0.0, optional=True),
    Cost("fatigue", 0.0, optional=True),
    Cost("head", 0.0, optional=True),
    Cost("impact", 0.0, optional=True),
    Cost("footfall", 0.0, needs=("clock",), optional=True),
    Cost("clearance", 0.0, needs=("clock", "reward.clearance_height"), optional=True),
    Cost("toes", 0.0, needs=("clock",), optional=True),
    Cost("vault", 0.0, needs=("clock",), optional=True),
    Cost("out_of_plane", 0.0, optional=True),
    Cost("track", 0.0, needs=("clock", "reward.track_scale", "tracking"), schedule=_tracking, optional=True),
    Cost("track_rate", 0.0, needs=("clock", "reward.track_rate_scale", "tracking"), schedule=_tracking, optional=True),
    Cost("landing", 0.0, needs=("clock",), optional=True),
)
LegReward = reward_section("LegReward", __name__, TERMS, LegShape)


@with_reward(LegReward)
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
    reward: LegShape = LegShape()

    @model_validator(mode="after")
    def _clock_and_speeds(self) -> "LegSettings":
        if self.symmetric and not self.clock:
            raise ValueError("env.symmetric needs the phase of the walk: write env.clock: true")
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
        if self.push.speed == 0.0:
            unread["push.interval"] = "env.push.speed is 0"
        if not self.tracking.epochs:
            unread["tracking.start"] = "env.tracking.epochs is 0"
        if self.clock:
            reason = "env.clock gives people's cadence and step length"
            unread |= dict.fromkeys(("reward.stride_angle", "reward.cadence"), reason)
        if not self.early_termination:
            unread["min_height"] = "env.early_termination is false"
        if self.target_speed == 0.0:
            unread["success_speed"] = "env.target_speed 0 asks to stand"
        return unread
