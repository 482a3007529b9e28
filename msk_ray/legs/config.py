"""The settings shared by muscle-driven legs."""

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import PositiveFloat, model_validator

from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.schedules import ramp
from msk_ray.config.sections import Count, EnvSettings, Fraction, NonNegative, Reward, Section, Whole
from msk_ray.config.terms import Cost, Term, terms_in

OUT_OF_PLANE = ("hip_adduction", "hip_rotation", "subtalar_angle")
"""Joints, without their side, whose angles the term `out_of_plane` keeps small."""


class LegShape(Reward):
    """The settings of terms other than their weights."""

    speed_scale: PositiveFloat = 0.6
    """Speed error at which the term `forward_vel` has fallen to 1/e [m/s]."""
    clearance_height: PositiveFloat = 0.01
    """Height above their place in standing that feet should have in swing [m]; people's toes clear the ground by 1 to 2
    cm."""


class AssistConfig(Section):
    """Springs and dampers that hold the pelvis up during training, annealed to zero.

    Evaluation never uses them.
    """

    epochs: Whole = 0
    """Epochs until they are gone; 0: none at all."""
    share: Fraction = 1.0
    """Share of their full stiffness at epoch 0."""
    power: PositiveFloat = 1.0
    """The share falls as (1 - epoch / epochs)^power: above 1, more epochs have weak springs, which leave the balance to
    the policy."""
    steady: PositiveFloat | None = None
    """Training time from the end of one episode to the next [s] from which an epoch counts as one of `epochs`: the
    springs stay as strong as they are while the legs fall sooner. Null: every epoch counts."""

    def at(self, epoch: int) -> float:
        """Share of the stiffness after `epoch` epochs that count."""
        return self.share * ramp(1.0, 0.0, epoch, self.epochs) ** self.power if self.epochs else 0.0

    def unread(self) -> dict[str, str]:
        """Settings that nothing reads, with the reason."""
        names = () if self.epochs else ("share", "power", "steady")
        return {f"assist.{name}": "env.assist.epochs is 0" for name in names}


class PushConfig(Section):
    """Pushes of the pelvis, which change its speed at once."""

    speed: NonNegative = 0.0
    """Change of the pelvis's horizontal velocity [m/s]; 0: no pushes."""
    interval: PositiveFloat = 2.0
    """Time between pushes [s]; their directions go around by 137.5° from one to the next and from world to world."""


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
    Cost("capture", 0.3),
    Cost("sway", 0.02),
    Cost("symmetry", 0.0),
    Cost("stride", 0.0),
    Cost("metabolic", 0.0, optional=True),
    Cost("head", 0.0, optional=True),
    Cost("impact", 0.0, optional=True),
    Cost("footfall", 0.0, needs=("clock",), optional=True),
    Cost("clearance", 0.0, needs=("clock", "reward.clearance_height"), optional=True),
    Cost("toes", 0.0, needs=("clock",), optional=True),
    Cost("vault", 0.0, needs=("clock",), optional=True),
    Cost("out_of_plane", 0.0, optional=True),
    Cost("track", 0.0, needs=("clock",), optional=True),
    Cost("track_rate", 0.0, needs=("clock",), optional=True),
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
    early_termination: bool = True
    """End an episode on a fall: with the pelvis below 65 % of its standing height, or the trunk tilted by more than
    60°."""
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
        return unread
