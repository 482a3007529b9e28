"""The algorithms that `algorithm.name` can take, and the settings that each declares.

The package's algorithms have their own top-level sections in a config, `shac` and `ppo`; those from outside use
`algorithm.settings`. Sources of SHAC's defaults: Xu et al. 2022, "Accelerated Policy Learning with Parallel
Differentiable Simulation", arXiv:2204.07137, and the hyperparameters published with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import (
    BeforeValidator,
    Field,
    PositiveFloat,
    SerializeAsAny,
    ValidationInfo,
    model_validator,
)

from msk_ray.config.horizons import AdaptiveHorizon, ContactHorizon, Horizon, HorizonSchedule
from msk_ray.config.physics import GRADIENTS
from msk_ray.config.schedules import ramp
from msk_ray.config.sections import SHOWN, Count, Fraction, NonNegative, Rate, Section, Text, Undeclared
from msk_ray.errors import ConfigError
from msk_ray.registry import Registry, resolve

if TYPE_CHECKING:
    from msk_ray.config.schema import Config

ALGORITHMS = Registry(
    "algorithm.name",
    "msk_ray.algorithms",
    {"shac": "msk_ray.algorithms.shac.algorithm:Shac", "ppo": "msk_ray.algorithms.ppo.algorithm:Ppo"},
)
"""Classes of algorithms. The package's own have their settings in the config's section of the same name."""


class AlgorithmSettings(Section):
    """An algorithm's settings, and facts about it that other settings depend on."""

    differentiates: ClassVar[bool] = True
    """Whether it needs gradients of the simulation; if not, settings of gradients are unused."""
    reads_not: ClassVar[frozenset[str]] = frozenset()
    """Dotted settings of other sections that it does not use."""
    packages: ClassVar[Mapping[str, str]] = {}
    """Optional modules that it needs → what to install."""
    length: ClassVar[str | None] = None
    """Its setting for the number of env steps that a world takes in an epoch."""
    parallel: ClassVar[bool] = False
    """Whether several processes can train one trial (`execution.gpus`)."""

    def env_steps(self, nworld: int, epochs: int) -> int:
        """Upper bound on the env steps that this many epochs of W worlds take.

        Raises:
            ConfigError: the algorithm does not define it.
        """
        raise ConfigError(
            f"{type(self).__qualname__} does not say how many env steps an epoch takes: define its method env_steps, "
            "or scheduler.time_attr: epoch"
        )

    def shortened(self, epochs: int) -> dict[str, Any]:
        """Settings for a smoke test: each of `epochs` epochs lasts about a second."""
        return {}

    def shortest(self) -> dict[str, Any]:
        """Settings for a minimal epoch that launches every kernel, to compile them."""
        return {}

    def check(self, config: Config) -> None:
        """Refuse settings of other sections that are incompatible with these.

        Raises:
            ValueError: the message says what to write instead.
        """

    def unread(self) -> dict[str, str]:
        """Dotted settings of this section that have no effect because of others → the reason."""
        return {}


class UndeclaredAlgorithm(AlgorithmSettings, Undeclared):
    """Recorded settings of an algorithm whose class is not installed here."""

    parallel = True


class EntropyConfig(Section):
    """Entropy bonus, as in SAPO (Xing et al. 2024, arXiv:2412.12089); values become soft values."""

    coefficient: PositiveFloat = 0.01
    """α [reward per nat], or its initial value if there is a target."""
    target: float | None = None
    """Entropy per action dimension [nat] to which α is adapted; null keeps α. Uniform actions have ln 2 = 0.69."""
    normalize: bool = False
    """Multiply α with (H + |T|) / 2|T| instead of the entropy H, where T is the target summed over action dimensions.
    As in SAPO, this is 0 at H = −|T|, and α does not depend on the number of actions."""

    @model_validator(mode="after")
    def _normalized_by_something(self) -> EntropyConfig:
        if self.normalize and not self.target:
            raise ValueError("entropy.normalize divides by the target: write a target other than 0")
        return self


class ExplorationSchedule(Section):
    """Factor on the standard deviation of actions: `start` at epoch 0, `end` from epoch `epochs` on, linear between.

    The standard deviation itself is still learned.
    """

    start: NonNegative
    end: NonNegative
    epochs: Count

    def at(self, epoch: int) -> float:
        """The factor at `epoch`, counted from 0."""
        return ramp(self.start, self.end, epoch, self.epochs)


class ShacConfig(AlgorithmSettings):
    """Short-Horizon Actor-Critic."""

    length: ClassVar[str | None] = "horizon"
    parallel: ClassVar[bool] = True

    horizon: Horizon = 32
    """Env steps H of a rollout through which the gradient flows: a number, {kind: schedule, start, end, epochs},
    {kind: adaptive, start, target} to follow the gradient, or {kind: contact, start, contact} to follow contact."""
    gamma: Fraction = 0.99
    """Discount."""
    lam: Fraction = 0.95
    """λ of the TD(λ) targets."""
    critic_iterations: Count = 16
    """Passes over the rollout per epoch; with `critic_tolerance`, at most this many."""
    critic_tolerance: PositiveFloat | None = None
    """Stop when the loss changes by less than this share of itself per pass, averaged over the last four passes (AHAC
    has an absolute threshold); null: never stop early. A recorded fit computes all passes, but skips the optimiser's
    steps after the stop."""
    critic_batches: Count = 4
    """Minibatches per pass."""
    target_critic_alpha: Fraction = 0.2
    """target ← α·target + (1 − α)·critic after each epoch."""
    actor_lr: Rate = 2e-3
    """Learning rate of the actor."""
    critic_lr: Rate = 2e-3
    """Learning rate of the critic."""
    lr_schedule: Literal["linear", "constant"] = "linear"
    """`linear` decreases from the given rate towards `final_lr`, reached after the last epoch."""
    final_lr: Rate = 1e-5
    """Learning rate at which the linear schedule ends; lower given rates stay constant."""
    weight_decay: NonNegative = 0.0
    """Decoupled weight decay of AdamW, for actor and critic; 0: Adam. SAPO has 0.01."""
    actor_grad_norm: PositiveFloat | None = 1.0
    """Norm to which the actor's gradient is clipped; null: no clipping."""
    critic_grad_norm: PositiveFloat | None = 1.0
    """Norm to which each critic's gradient is clipped; null: no clipping."""
    state_bptt: bool = True
    """Let gradients flow through the state from one env step to the next; false detaches the state at each step."""
    state_grad_clip: PositiveFloat | None = None
    """Bound on each world's state cotangent between env steps, in units of reward; null: no bound.

    The loss is a mean over H·W, so a single reward of c gives a cotangent of norm c/(H·W).
    """
    entropy: EntropyConfig | None = None
    """Entropy bonus; null: none."""
    actor_value: Literal["smaller", "mean"] = "smaller"
    """How two critics' values are combined in the actor's loss; SAPO uses the mean. The critic's targets always use the
    smaller value."""
    exploration: ExplorationSchedule | None = None
    """Factor on the standard deviation of the actions by epoch; null: 1."""
    normalize_return: bool = False
    """Divide rewards by the running standard deviation of the return."""
    reward_scale: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0
    """Factor on rewards in training; scores are not scaled."""

    def env_steps(self, nworld: int, epochs: int) -> int:
        """Sum over epochs of horizon × worlds; an adaptive horizon counts as its `longest`."""
        horizon = self.horizon
        if isinstance(horizon, HorizonSchedule):
            return nworld * sum(horizon.at(epoch) for epoch in range(epochs))
        return nworld * epochs * (horizon if isinstance(horizon, int) else horizon.longest)

    def shortened(self, epochs: int) -> dict[str, Any]:
        """A quarter of the horizon, and two passes of one batch for the critic."""
        horizon: Any = self.horizon
        if isinstance(horizon, int):
            horizon = _quarter(horizon)
        elif isinstance(horizon, AdaptiveHorizon | ContactHorizon):
            lengths = {name: _quarter(getattr(horizon, name)) for name in ("start", "shortest", "longest")}
            horizon = {**horizon.model_dump(), **lengths}
        else:
            ends = {"start": _quarter(horizon.start), "end": _quarter(horizon.end)}
            horizon = {"kind": "schedule", **ends, "epochs": epochs - 1}
        return {"horizon": horizon, "critic_batches": 1, "critic_iterations": min(self.critic_iterations, 2)}

    def shortest(self) -> dict[str, Any]:
        """A horizon of two steps, and one pass of one batch for the critic."""
        return {"horizon": 2, "critic_iterations": 1, "critic_batches": 1}

    def check(self, config: Config) -> None:
        """Refuse critic batches that do not divide a rollout, and settings that contradict others."""
        horizon, nworld = self.horizon, config.env.nworld
        if isinstance(horizon, HorizonSchedule):
            shortest = min(horizon.start, horizon.end)
        else:
            shortest = horizon if isinstance(horizon, int) else horizon.shortest
        gpus = config.execution.gpus
        also = f" × execution.gpus {gpus}" if gpus > 1 else ""
        if (shortest * nworld) % (self.critic_batches * gpus):
            raise ValueError(
                f"shac.critic_batches {self.critic_batches}{also} must divide shac.horizon × env.nworld "
                f"({shortest} × {nworld})"
            )
        if self.exploration is not None and self.entropy is not None:
            raise ValueError("shac.exploration changes the noise that shac.entropy measures: leave one out")
        if self.actor_value == "mean" and config.critic.count == 1:
            raise ValueError("shac.actor_value: mean is of two critics: write critic.count: 2")
        if isinstance(horizon, ContactHorizon) and "cone" not in config.env.reads_physics:
            raise ValueError(f"shac.horizon.contact: {config.env.name} has no contacts; write a number")

    def unread(self) -> dict[str, str]:
        """Settings that have no effect because of another setting."""
        unread = {}
        if self.lr_schedule == "constant":
            unread["final_lr"] = "lr_schedule is constant"
        if not self.state_bptt:
            unread["state_grad_clip"] = "state_bptt is false"
        return unread


class PpoConfig(AlgorithmSettings):
    """Proximal Policy Optimization by rsl-rl-lib. Its defaults are those that library's authors use for locomotion."""

    differentiates: ClassVar[bool] = False
    reads_not: ClassVar[frozenset[str]] = frozenset(
        (
            "actor.log_std",
            "actor.state_std",
            "actor.output_gain",
            "critic.count",
            "execution.capture",
        )
    )
    packages: ClassVar[Mapping[str, str]] = {"rsl_rl": "msk-ray[ppo]"}
    length: ClassVar[str | None] = "steps"

    steps: Count = 24
    """Env steps per world and epoch."""
    passes: Count = 5
    """Passes over an epoch's steps."""
    minibatches: Count = 4
    """Minibatches per pass."""
    clip: PositiveFloat = 0.2
    """Bound on how much the ratio of new to old probabilities, and the value, may change in an epoch."""
    gamma: Fraction = 0.99
    """Discount."""
    lam: Fraction = 0.95
    """λ of the generalised advantage estimate."""
    lr: Rate = 1e-3
    """Adam's learning rate, or its initial value if the schedule is adaptive."""
    lr_schedule: Literal["adaptive", "constant"] = "adaptive"
    """`adaptive` divides or multiplies the rate by 1.5, between 1e-5 and 1e-2, to hold `desired_kl`."""
    desired_kl: PositiveFloat = 0.01
    """Divergence of the new policy from the old one [nat]."""
    entropy_coefficient: NonNegative = 0.0
    """Weight of the entropy bonus."""

    def env_steps(self, nworld: int, epochs: int) -> int:
        """Worlds × steps × epochs."""
        return nworld * self.steps * epochs

    def shortened(self, epochs: int) -> dict[str, Any]:
        """A quarter of the steps, two passes of one batch."""
        return {"steps": _quarter(self.steps), "passes": min(self.passes, 2), "minibatches": 1}

    def shortest(self) -> dict[str, Any]:
        """Two steps, one pass of one batch."""
        return {"steps": 2, "passes": 1, "minibatches": 1}

    def check(self, config: Config) -> None:
        """Refuse minibatches that do not divide an epoch, and settings that PPO does not support."""
        if (self.steps * config.env.nworld) % self.minibatches:
            raise ValueError(
                f"ppo.minibatches {self.minibatches} must divide ppo.steps × env.nworld "
                f"({self.steps} × {config.env.nworld})"
            )
        for name, network in (("actor", config.actor), ("critic", config.critic)):
            if not network.hidden:
                raise ValueError(f"ppo needs hidden layers: write {name}.hidden: [64, 64]")
        if config.curriculum is not None:
            raise ValueError("curriculum: ppo trains without one; write curriculum: null, or algorithm.name: shac")

    def unread(self) -> dict[str, str]:
        """Settings that have no effect because of another setting."""
        return {"desired_kl": "lr_schedule is constant"} if self.lr_schedule == "constant" else {}


def _quarter(length: int) -> int:
    return max(2, length // 4)


BUILT_IN: Mapping[str, type[AlgorithmSettings]] = {"shac": ShacConfig, "ppo": PpoConfig}
"""Settings of the package's algorithms, by the section that holds them."""


def _settings_from_outside(value: Any, info: ValidationInfo) -> Any:
    """`algorithm.settings` as the settings that the algorithm named declares."""
    name = info.data.get("name")
    if type(value) is AlgorithmSettings:
        value = {}  # none were given
    if name is None or isinstance(value, AlgorithmSettings):
        return value
    if name in BUILT_IN:
        if value == {}:
            return AlgorithmSettings()
        first = f".{next(iter(value))}" if isinstance(value, Mapping) else ""
        raise ValueError(f"algorithm.settings: the settings of {name} have their own section; write {name}{first}")
    try:
        settings = settings_from_outside(name)
    except ConfigError as error:
        if info.context == SHOWN:
            return UndeclaredAlgorithm.because(str(error), value)
        raise ValueError(str(error)) from error
    return settings.model_validate(value, context=info.context)


class AlgorithmConfig(Section):
    """Which algorithm learns."""

    name: Text = "shac"
    """`shac`, `ppo`, or package.module:Class."""
    settings: Annotated[SerializeAsAny[AlgorithmSettings], BeforeValidator(_settings_from_outside)] = (
        AlgorithmSettings()
    )
    """Settings of an algorithm from outside, declared by its class. Those of shac and ppo have their own sections."""


def settings_from_outside(name: Any) -> type[AlgorithmSettings]:
    """The settings class of the algorithm with this import path or installed name.

    Raises:
        ConfigError: there is no such algorithm, or it declares something else.
    """
    path = ALGORITHMS.path(name)
    declared = getattr(resolve(path, ALGORITHMS.key), "Settings", None)
    if not (isinstance(declared, type) and issubclass(declared, AlgorithmSettings)):
        raise ConfigError(f"algorithm.name: {path} declares no settings: write `class Settings(AlgorithmSettings)`")
    return declared


def ignored_settings(name: str, settings: AlgorithmSettings) -> list[str]:
    """Sections and settings, dotted, that a trial of this algorithm does not read."""
    sections = [section for section in BUILT_IN if section != name]
    gradients = [] if settings.differentiates else [f"physics.{key}" for key in sorted(GRADIENTS)]
    return [*sections, *sorted(settings.reads_not), *gradients]
