"""The settings of a trial. Every field has a unit or range; unknown keys are refused.

Sources of the defaults: SHAC (Xu et al. 2022, "Accelerated Policy Learning with Parallel Differentiable Simulation",
arXiv:2204.07137) and the hyperparameters published with it.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    PositiveFloat,
    SerializeAsAny,
    Tag,
    ValidationInfo,
    model_validator,
)

from msk_ray.config.environments import settings_class
from msk_ray.config.physics import PhysicsConfig, Vec5
from msk_ray.config.sections import Count, EnvSettings, Fraction, Section, Text, Whole
from msk_ray.config.unread import unread_settings
from msk_ray.errors import ConfigError, brief


def _declared_settings(value: Any, info: ValidationInfo) -> Any:
    """The `env` section as the settings that the environment it names declares."""
    if isinstance(value, EnvSettings) or not isinstance(value, Mapping):
        return value
    try:
        settings = settings_class(value.get("name"))
    except ConfigError as error:
        raise ValueError(str(error)) from error
    return settings.model_validate(value, context=info.context)


class HorizonSchedule(Section):
    """Rollout length by epoch: `start` at epoch 0, `end` from epoch `epochs` on, linear between."""

    start: Count
    end: Count
    epochs: Count

    def at(self, epoch: int) -> int:
        """Env steps at `epoch`, counted from 0."""
        progress = min(1.0, epoch / self.epochs)
        return round(self.start + (self.end - self.start) * progress)


class AdaptiveHorizon(Section):
    """Rollout length that follows the gradient: longer while cotangents stay small, shorter when they grow.

    After each epoch H ← H (target / p90)^rate within bounds, p90 being the 90th percentile of the state cotangents'
    norms in units of reward. Adaptive horizons are the idea of AHAC (Georgiev et al. 2024, arXiv:2405.17784), which
    follows a constraint on contact forces; this one follows the cotangents themselves.
    """

    start: Count
    shortest: Count = 4
    longest: Count = 64
    target: PositiveFloat
    """Wanted 90th percentile of the cotangent norms, before any bound [reward]."""
    rate: Annotated[float, Field(gt=0.0, le=1.0)] = 0.1

    @model_validator(mode="after")
    def _bounds(self) -> "AdaptiveHorizon":
        if not self.shortest <= self.start <= self.longest:
            raise ValueError(
                f"adaptive horizon: start {self.start} must lie between shortest {self.shortest} and longest "
                f"{self.longest}"
            )
        return self


def _kind_of_horizon(value: Any) -> str:
    if isinstance(value, dict):
        return "adaptive" if "target" in value else "schedule"
    if isinstance(value, AdaptiveHorizon):
        return "adaptive"
    return "schedule" if isinstance(value, HorizonSchedule) else "constant"


Horizon = Annotated[
    Annotated[Count, Tag("constant")]
    | Annotated[HorizonSchedule, Tag("schedule")]
    | Annotated[AdaptiveHorizon, Tag("adaptive")],
    Discriminator(_kind_of_horizon),
]


class EntropyConfig(Section):
    """Bonus α for the policy's entropy, as in SAPO (Xing et al. 2024, arXiv:2412.12089); values become soft values."""

    coefficient: PositiveFloat = 0.01
    """α [reward per nat], or where it starts if there is a target."""
    target: float | None = None
    """Entropy per action dimension [nat] that α is adapted to hold; null keeps α. Uniform actions have ln 2 = 0.69."""
    rate: PositiveFloat = 5e-3
    """Change of log α per epoch and nat of missing entropy."""


class ContactStart(Section):
    """Contact physics at the start of a curriculum; fields left null stay as the trial's physics has them."""

    solref: tuple[PositiveFloat, PositiveFloat] | None = None
    """Contact time constant [s] and damping ratio."""
    solimp: Vec5 | None = None
    solreffriction: tuple[PositiveFloat, PositiveFloat] | None = None
    """Time constant [s] and damping ratio of the friction directions; (1, 1) is viscous."""
    friction: PositiveFloat | None = None
    """Sliding friction coefficient."""

    @model_validator(mode="after")
    def _something(self) -> "ContactStart":
        if not self.model_dump(exclude_none=True):
            raise ValueError("write at least one of solref, solimp, solreffriction, friction")
        return self


class ContactCurriculum(Section):
    """Train first in softer contacts, and go over to those of `physics` step by step."""

    start: ContactStart
    epochs: Count
    """Steps from `start` to the trial's physics, one an epoch."""
    reward: float | None = None
    """Mean reward per env step an epoch must reach for a step to be taken; null takes one every epoch."""


class NetworkConfig(Section):
    """A multilayer perceptron."""

    hidden: Annotated[tuple[Annotated[int, Field(gt=0, le=65536)], ...], Field(max_length=64)] = (64, 64)
    activation: Literal["elu", "silu", "relu", "tanh"] = "elu"
    layer_norm: bool = True
    """Normalise each hidden layer."""


class ActorConfig(NetworkConfig):
    """Policy network. Its output is squashed by tanh."""

    stochastic: bool = True
    """Gaussian with state-independent standard deviation; False is deterministic."""
    log_std: float = -1.0
    """Initial log standard deviation, before tanh."""
    output_gain: PositiveFloat = 1.0
    """Gain of the last layer's initial weights; a small one starts from action 0, whatever is observed."""


class CriticConfig(NetworkConfig):
    """Value network(s)."""

    count: Annotated[int, Field(ge=1, le=2)] = 1
    """Critics trained; with two, the smaller value is used."""


class ShacConfig(Section):
    """Short-Horizon Actor-Critic."""

    horizon: Horizon = 32
    """Env steps H of a rollout the gradient flows through: constant, {start, end, epochs}, or by the gradient as
    {start, target}."""
    gamma: Fraction = 0.99
    """Discount."""
    lam: Fraction = 0.95
    """λ of the TD(λ) targets."""
    critic_method: Literal["td-lambda", "one-step"] = "td-lambda"
    """Targets of the critic."""
    critic_iterations: Count = 16
    """Passes over the rollout an epoch."""
    critic_batches: Count = 4
    """Minibatches a pass."""
    target_critic_alpha: Fraction = 0.2
    """target ← α·target + (1 − α)·critic after each epoch."""
    actor_lr: PositiveFloat = 2e-3
    critic_lr: PositiveFloat = 2e-3
    lr_schedule: Literal["linear", "constant"] = "linear"
    """`linear` goes from the given rate to `final_lr` at the last epoch."""
    final_lr: PositiveFloat = 1e-5
    betas: tuple[Fraction, Fraction] = (0.7, 0.95)
    """Adam's moment decays."""
    actor_grad_norm: PositiveFloat | None = 1.0
    """Norm the actor's gradient is clipped to; null leaves it."""
    critic_grad_norm: PositiveFloat | None = 1.0
    """Norm each critic's gradient is clipped to; null leaves it."""
    state_bptt: bool = True
    """Let gradients flow through the state from one env step to the next; False cuts them after each step."""
    state_grad_clip: PositiveFloat | None = None
    """Bound on each world's state cotangent between env steps, in units of reward; null leaves it.

    The loss is a mean over H·W, so a world's cotangent of norm c/(H·W) is what one reward of c would give.
    """
    entropy: EntropyConfig | None = None
    """Bonus for the policy's entropy; null gives none."""
    normalize_obs: bool = True
    """Normalise observations by their running mean and variance."""
    normalize_return: bool = False
    """Divide rewards by the running standard deviation of the return."""
    reward_scale: PositiveFloat = 1.0
    max_nonfinite_share: Fraction = 0.05
    """Share of worlds whose gradient may be non-finite in an epoch before the trial stops with an error."""


class EvaluationConfig(Section):
    """Deterministic evaluation on fixed seeds: the only thing policies are ranked by."""

    interval: Count = 10
    """Epochs between evaluations."""
    nworld: Count = 64
    steps: Count | None = None
    """Env steps; null takes the env's episode length."""
    seed: Whole = 1234
    variant: Text | None = None
    """Physics the score is taken under; null takes the env's reference physics."""


class TrialConfig(Section):
    """How long, from which seed, and how often to save."""

    epochs: Count = 500
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    start_from: Text | None = None
    """Checkpoint of another trial whose networks and observation statistics this one starts from, such as a best.pt;
    null starts from random ones. Optimisers and worlds are new either way."""
    checkpoint_interval: Count = 10
    """Epochs between checkpoints."""
    keep_checkpoints: Annotated[int, Field(ge=2)] = 2
    """Newest checkpoints kept, beside the best."""
    threads: Count = 1
    """Threads that torch computes with on the CPU. Sums depend on their number, and so do the figures of a trial: it is
    this setting's, never the machine's. Networks of a few hundred units gain nothing by more than one."""


RECORDED = "recorded"
"""Context of validation in which settings that nothing reads are let through: earlier versions let them be written."""


class Config(Section):
    """One trial."""

    env: Annotated[SerializeAsAny[EnvSettings], BeforeValidator(_declared_settings)]
    physics: PhysicsConfig = PhysicsConfig()
    curriculum: ContactCurriculum | None = None
    """Softer contacts to begin with; null trains in `physics` from the start."""
    shac: ShacConfig = ShacConfig()
    actor: ActorConfig = ActorConfig()
    critic: CriticConfig = CriticConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    trial: TrialConfig = TrialConfig()

    @model_validator(mode="after")
    def _physics_fits_env(self) -> "Config":
        variants = self.env.variants
        for field, name in (("physics.variant", self.physics.variant), ("evaluation.variant", self.evaluation.variant)):
            if name is not None and name not in variants:
                known = f"write one of {', '.join(variants)}" if variants else "leave it out"
                raise ValueError(f"{field}: env {self.env.name} has no physics named {brief(name)}; {known}")
        return self

    @model_validator(mode="after")
    def _consistent(self) -> "Config":
        self.physics.resolve_substeps(self.env.control_timestep)
        horizon = self.shac.horizon
        if isinstance(horizon, HorizonSchedule):
            shortest = min(horizon.start, horizon.end)
        else:
            shortest = horizon if isinstance(horizon, int) else horizon.shortest
        if (shortest * self.env.nworld) % self.shac.critic_batches:
            raise ValueError(
                f"shac.critic_batches {self.shac.critic_batches} must divide shac.horizon × env.nworld "
                f"({shortest} × {self.env.nworld})"
            )
        if self.shac.entropy is not None and not self.actor.stochastic:
            raise ValueError("shac.entropy needs a stochastic policy: write actor.stochastic: true")
        if self.curriculum is not None:
            self._check_curriculum()
        return self

    def _check_curriculum(self) -> None:
        if "cone" not in self.env.reads_physics:
            raise ValueError(f"curriculum: {self.env.name} has no contacts; leave it out")
        if self.physics.backward not in ("tape_per_substep", "tape_all"):
            raise ValueError("curriculum needs physics.backward: tape_per_substep or tape_all")

    @model_validator(mode="after")
    def _everything_is_read(self, info: ValidationInfo) -> "Config":
        if info.context != RECORDED:
            for key, why, _ in unread_settings(self):
                raise ValueError(f"{key}: {why} leave it out")
        return self

    def as_dict(self) -> dict[str, Any]:
        """Plain data that `parse_config` reads back."""
        return self.model_dump(mode="json")
